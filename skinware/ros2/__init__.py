"""Drivers in a ROS 2 graph, without ROS: what is told there, and the carriers that tell it."""
