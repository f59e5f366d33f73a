"""Decode frames into updates: layouts are compiled to lookup tables and applied to whole batches."""
