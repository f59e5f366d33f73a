"""The emulated ROBOSKIN: boards with their firmware, touch and faults."""
