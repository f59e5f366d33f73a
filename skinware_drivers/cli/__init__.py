"""Commands that need a bus, one module each."""
