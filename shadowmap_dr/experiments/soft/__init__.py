"""Images under area lights and environments, beside path-traced ones."""
