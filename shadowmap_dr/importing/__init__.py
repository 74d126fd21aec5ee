"""Models of other programs (glTF, OBJ, PLY, STL, OFF) as Mitsuba scenes."""

from .importer import Imported, import_model
from .options import ImportOptions

__all__ = ["ImportOptions", "Imported", "import_model"]
