"""Choice of the LLVM library of a process. Each case runs in a process of its own: Dr.Jit loads LLVM only once."""

from __future__ import annotations

import glob
import os
import subprocess
import sys
from pathlib import Path

import drjit as dr
import pytest

from shadowmap_dr import _llvm

OLD = [path for path in sorted(glob.glob("/usr/lib/*-linux-gnu/libLLVM-1[56].so*")) if Path(path).is_file()]

needs_llvm = pytest.mark.skipif(not dr.has_backend(dr.JitBackend.LLVM), reason="no LLVM")
no_gpu = pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="with a GPU, LLVM is not needed")

# An operation that LLVM 15 cannot compile, and a render.
USE = """
import drjit as dr, mitsuba as mi
mi.set_variant('llvm_ad_rgb')
assert dr.detail.llvm_version()[0] >= 17
assert dr.allclose(dr.minimum(mi.Float(1, 2), 1.5), [1, 1.5])
film = {'type': 'hdrfilm', 'width': 4, 'height': 4}
scene = {'type': 'scene', 'sensor': {'type': 'perspective', 'film': film}, 'light': {'type': 'constant'}}
assert mi.render(mi.load_dict({**scene, 'integrator': {'type': 'direct'}}), spp=1).shape == (4, 4, 3)
"""


def run(code: str, **environment: str | None) -> subprocess.CompletedProcess[str]:
    variables = {k: v for k, v in os.environ.items() if k != _llvm.ENVIRONMENT_VARIABLE}
    for name, value in environment.items():
        variables.pop(name, None)
        if value is not None:
            variables[name] = value
    return subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, timeout=300)


def installed_hook() -> bool:
    """True if this environment has the start-up file that serves scripts which import mitsuba first."""
    return any(Path(folder, "shadowmap_dr_llvm.pth").is_file() for folder in sys.path if folder)


@needs_llvm
@pytest.mark.parametrize(
    "first",
    [
        "import shadowmap_dr, mitsuba",
        "import shadowmap_dr, drjit",
        pytest.param("import mitsuba, shadowmap_dr", id="mitsuba first"),
        pytest.param("import drjit; from drjit.llvm.ad import Float; import shadowmap_dr", id="drjit first"),
        pytest.param("import mitsuba; mitsuba.set_variant('llvm_ad_rgb'); import shadowmap_dr", id="variant first"),
    ],
)
def test_order_of_imports(first: str) -> None:
    if not first.startswith("import shadowmap_dr") and not installed_hook():
        pytest.skip("the package is used without being installed")
    result = run(first + USE)
    assert result.returncode == 0, result.stderr


@needs_llvm
@pytest.mark.parametrize("home", ["", None, "/proc/nowhere"])
def test_home_directory_is_not_needed(home: str | None) -> None:
    result = run("import shadowmap_dr" + USE, HOME=home)
    assert result.returncode == 0, result.stderr


@needs_llvm
@pytest.mark.parametrize("named", ["/nowhere/libLLVM.so", *OLD[:1]])
def test_unusable_library_in_the_environment_is_replaced(named: str) -> None:
    result = run("import shadowmap_dr" + USE, DRJIT_LIBLLVM_PATH=named)
    assert result.returncode == 0, result.stderr
    assert named in result.stderr


@needs_llvm
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"no library", "but is no shared library"),
        (b"\x7fELF and no more", "but cannot be loaded"),
        (b"", "but is no shared library"),
        (None, "but is another one"),
    ],
)
def test_files_that_are_only_named_like_llvm(tmp_path: Path, content: bytes | None, reason: str) -> None:
    path = tmp_path / "libLLVM-19.so"
    path.write_bytes(Path(_another_library()).read_bytes() if content is None else content)
    result = run("import shadowmap_dr" + USE, DRJIT_LIBLLVM_PATH=str(path))
    assert result.returncode == 0, result.stderr
    assert f"{path} is named like an LLVM library, {reason}" in " ".join(result.stderr.split())


def _another_library() -> str:
    """Path of a shared library of this process that is not LLVM."""
    import _ctypes

    return str(_ctypes.__file__)


@no_gpu
@pytest.mark.parametrize("named", ["/nowhere/libLLVM.so", *OLD[:1]])
def test_one_clear_sentence_when_it_is_too_late(named: str) -> None:
    result = run("import mitsuba, shadowmap_dr", DRJIT_LIBLLVM_PATH=named)
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("shadowmap_dr.errors.LLVMError: ") and "import shadowmap_dr before mitsuba" in last


@no_gpu
def test_message_names_the_package_when_there_is_no_library() -> None:
    code = (
        "import sys, importlib.util as u, importlib.metadata, os\n"
        "import drjit\n"  # with an unusable library
        "import glob; glob.glob = lambda *a, **k: []\n"
        "import pathlib; pathlib.Path.glob = lambda *a, **k: iter(())\n"
        "def missing(name): raise importlib.metadata.PackageNotFoundError(name)\n"
        "importlib.metadata.distribution = missing\n"
        "import shadowmap_dr"
    )
    result = run(code, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert "install LLVM 17 or newer" in last


@pytest.mark.skipif(_llvm._wheel_library() is None, reason="the LLVM wheel is not installed")
def test_read_only_environment_without_the_wheels_links(tmp_path: Path) -> None:
    """Before an interpreter has created the wheel's links, the C++ runtime must be loaded by hand."""
    library = _llvm._wheel_library()
    assert library is not None
    runtime = library.parent / "x86_64-unknown-linux-gnu"
    copy = tmp_path / "lib" / runtime.name
    copy.mkdir(parents=True)
    (copy.parent / library.name).symlink_to(library)
    for path in runtime.iterdir():
        if not path.is_symlink():
            (copy / path.name).write_bytes(path.read_bytes())
    assert not (copy / "libc++.so.1").exists()
    # The loader resolves the symbolic link's own folder, so that only the preloaded copies can serve.
    code = f"import os; os.environ['DRJIT_LIBLLVM_PATH'] = {str(copy.parent / library.name)!r}\nimport shadowmap_dr" + USE
    result = run(code + f"\nassert {str(copy)!r} in open('/proc/self/maps').read()")
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", 14),
        ("/x/lib/libLLVM.so.19.1", 19),
        ("/usr/lib/llvm-18/lib/libLLVM.so.1", 18),
        ("/nowhere/libLLVM.so", 0),
    ],
)
def test_version_from_the_file_name(path: str, version: int) -> None:
    assert _llvm._file_version(Path(path)) == version
