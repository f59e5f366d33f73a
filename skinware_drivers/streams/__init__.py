"""Buses over a network, on which every serial driver runs unchanged."""
