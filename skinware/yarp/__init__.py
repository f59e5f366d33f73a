"""Speak YARP, the middleware of iCub and its relatives, without its library."""
