"""Serial lines: framing, the bus, and the adapter that drivers of serial devices subclass."""
