"""Models of other programs (glTF, OBJ, PLY, STL, OFF) as Mitsuba scenes."""

from .importer import Imported, import_model

__all__ = ["Imported", "import_model"]
