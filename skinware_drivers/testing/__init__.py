"""Test drivers: a conformance suite, fixtures (see ``plugin``), and the CAN lab. Only this package imports pytest."""
