"""Scenes on which Mitsuba tests the derivatives of its own integrators, and how far this project's are from Mitsuba's."""
