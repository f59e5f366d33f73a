"""Find devices, their traffic and the programs that use them, for ``skin-find`` and ``skin-config``."""
