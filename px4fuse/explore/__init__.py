"""Interactive web page about one flight: KF re-runs in the browser with other settings."""
