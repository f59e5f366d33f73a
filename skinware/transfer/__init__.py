"""Frames of services, taken out of a namespace as bytes and published in another: what recordings and bridges share."""
