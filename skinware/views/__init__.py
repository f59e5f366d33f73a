"""What a view of a skin needs, whatever it is drawn with: drivers followed live, places, levels, states."""
