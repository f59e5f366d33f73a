"""A driver at work: buses opened, lost and found again, frames taken, decoded and published at the right moments."""
