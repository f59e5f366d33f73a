"""What an owner does to prove the driver of a device: press, let go and stroke, while somebody watches the values."""
