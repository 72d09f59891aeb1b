"""Records, files, texts and processes that every package uses."""
