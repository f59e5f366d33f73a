"""Emulators of devices, one module for each driver."""
