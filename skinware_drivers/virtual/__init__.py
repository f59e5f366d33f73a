"""Emulated hardware, in this process or on a real bus."""
