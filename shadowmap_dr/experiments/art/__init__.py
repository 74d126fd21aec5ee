"""Shadow art: designs, their pictures, and the gallery."""
