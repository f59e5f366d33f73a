"""YARP, the middleware of iCub and its relatives, spoken without its library."""
