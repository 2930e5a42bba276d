"""An experiment: its configuration, what is built from it, and its folder."""
