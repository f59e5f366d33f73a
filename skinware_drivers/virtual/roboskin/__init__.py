"""The emulated ROBOSKIN: its options, what its boards do and compute, what they feel, and what goes wrong."""
