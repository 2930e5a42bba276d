"""The laboratory: what experiments with the plug-in need."""
