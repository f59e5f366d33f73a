"""A Skinware driver of OptoForce's optical force sensors."""
