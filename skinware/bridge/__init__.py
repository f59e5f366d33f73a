"""A namespace on another machine: served there, joined here, over zenoh."""
