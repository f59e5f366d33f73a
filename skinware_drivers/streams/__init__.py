"""Streams over a network: serial devices behind TCP and UDP, as buses on which every serial driver runs unchanged."""
