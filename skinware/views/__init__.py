"""Views of a skin: drivers followed live, places, levels and states, and the server of the page."""
