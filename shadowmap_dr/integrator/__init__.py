"""The Mitsuba plug-in ``shadowmap``: its parameters, and the state of scenes that it keeps from one image to the next."""

from .registration import install

__all__ = [
    "install",
]
