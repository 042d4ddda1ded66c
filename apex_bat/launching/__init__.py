"""Starting, watching and restarting roles."""
