"""CAN: buses, and the drivers of skins that hang on them."""
