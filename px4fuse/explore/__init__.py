"""One HTML page on which a flight's filter is turned and watched: Analysis → page."""
