"""The experiments, one package each. Nothing here is needed to render or differentiate a scene."""
