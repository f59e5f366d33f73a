"""The shared-memory ring."""
