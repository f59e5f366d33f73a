"""Prove the driver of a device: a person presses, lets go and strokes, and the values are judged (``skin-prove``)."""
