"""The experiments, one module each. Nothing here is needed to render or differentiate a scene."""
