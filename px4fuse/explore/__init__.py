"""Interactive HTML page of one flight: KF re-runs in the browser with other settings."""
