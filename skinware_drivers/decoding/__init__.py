"""Frames to updates: layouts compiled to lookup tables, and applied to whole batches of frames."""
