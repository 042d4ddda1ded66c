"""What a run leaves to look at: metrics and flight recordings."""
