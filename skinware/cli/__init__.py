"""Commands that need no bus, one module each."""
