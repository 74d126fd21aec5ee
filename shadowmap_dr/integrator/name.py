"""The name of the plug-in."""

PLUGIN = "shadowmap"
