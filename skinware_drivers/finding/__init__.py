"""What is plugged in, what is heard on it, and who has it: the knowledge behind ``skin-find`` and ``skin-config``."""
