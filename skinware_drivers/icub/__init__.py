"""An iCub's own files: what they say of its skin, in our terms."""
