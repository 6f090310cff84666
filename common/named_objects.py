"""Objects that a user names as `module:name`: their own policies and estimators.

The module may lie in the working folder.
"""

import importlib
import sys
from pathlib import Path
from types import ModuleType


def named_module(name: str) -> ModuleType:
    """Import a module by its name, from the working folder too; whatever it raises on import is raised here."""
    here = str(Path.cwd())
    # At the end: what is installed keeps its names, whatever the working folder holds.
    sys.path.append(here)
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(here)
