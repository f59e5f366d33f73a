"""Translate an iCub's own files on its skin."""
