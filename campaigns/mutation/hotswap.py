"""Import changed sources instead of the files on disk, in this process only."""

from __future__ import annotations

import contextlib
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType


class _Swapped(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds and runs modules whose source was replaced."""

    def __init__(self, root: Path, sources: dict[str, str]) -> None:
        self._paths = {module_name(path): root / path for path in sources}
        self._sources = {module_name(path): source for path, source in sources.items()}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """A spec of ours for the modules that were replaced."""
        if fullname not in self._sources:
            return None
        origin = self._paths[fullname]
        packages = [str(origin.parent)] if origin.name == "__init__.py" else None
        spec = importlib.machinery.ModuleSpec(fullname, self, origin=str(origin), is_package=packages is not None)
        spec.submodule_search_locations = packages
        spec.has_location = True
        return spec

    def exec_module(self, module: ModuleType) -> None:
        """Run the replaced source in the module."""
        code = compile(self._sources[module.__name__], str(self._paths[module.__name__]), "exec", dont_inherit=True)
        exec(code, module.__dict__)  # a loader runs source: our own file with one change


def module_name(path: str) -> str:
    """`safety/limits.py` -> `safety.limits`."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def swap(root: Path, sources: dict[str, str]) -> None:
    """From now on this process imports these sources (by path relative to `root`). They must not be imported yet."""
    loaded = sorted(name for name in map(module_name, sources) if name in sys.modules)
    if loaded:
        raise ValueError(f"already imported: {', '.join(loaded)}; swap before the first import")
    sys.meta_path.insert(0, _Swapped(root, sources))


def forget(root: Path, kept: tuple[str, ...] = ("campaigns.mutation", "sim_gateway", "strict_yaml")) -> None:
    """Drop every imported module that lies under `root`, but for those that know nothing of what may be swapped."""
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        installed = file is not None and "site-packages" in Path(file).parts  # the environment may lie under `root`, too
        ours = file is not None and not installed and Path(file).is_relative_to(root)
        if ours and name not in {"campaigns", "__main__"} and not name.startswith(kept):
            del sys.modules[name]


def preload(names: Iterable[str]) -> None:
    """Import modules now, so that forked children need not."""
    for name in names:
        with contextlib.suppress(ImportError):  # made by its package only (vendored): the child imports it as the test does
            importlib.import_module(name)
