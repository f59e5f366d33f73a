"""The skin understood: numpy only, over arrays first; services and commands are built round it."""
