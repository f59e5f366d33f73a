"""Publish drivers in a ROS 2 graph, over DDS or zenoh, without ROS."""
