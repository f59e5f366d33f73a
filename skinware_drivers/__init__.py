"""The driver SDK: transport adapters, frame layouts, the runner, and the drivers that ship with it."""
