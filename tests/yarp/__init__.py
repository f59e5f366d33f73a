"""YARP: ports that are read, and ports that are served."""
