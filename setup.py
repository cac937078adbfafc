"""Builds the compiled core; everything else is in pyproject.toml."""

import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

from Cython.Build import cythonize
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

MODULES = sorted(path.stem for path in Path("apt_evap/_core").glob("*.pyx"))
BOUNDS = bool(os.environ.get("APT_EVAP_BOUNDS"))  # check every index: slow, for tools/sanitize.sh
DIRECTIVES = {
    "language_level": 3,
    "boundscheck": BOUNDS,
    "wraparound": False,
    "cdivision": True,
    "initializedcheck": False,
}
# APT_EVAP_ABI3=1 builds one wheel for Python 3.11 and later, as fast as the others: the wheels of a release.
ABI3 = bool(os.environ.get("APT_EVAP_ABI3"))
MACROS = [("Py_LIMITED_API", "0x030b0000")] * ABI3
if sys.platform == "win32":
    MACROS.append(("MS_WIN64", ""))  # for the headers of CPython and GCC
# -fno-math-errno lets sqrt vectorise (4-17 times); -ffp-contract=off keeps the bits the same on every processor.
FLAGS = ["-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off"]
# for compiler and linker: of GCC and clang, and of Apple's clang with libomp in CPATH and LIBRARY_PATH (not run yet)
OPENMP = [(["-fopenmp"], ["-fopenmp"]), (["-Xpreprocessor", "-fopenmp"], ["-lomp"])]


def compiles(compiler, flags):
    """Whether the compiler that will build accepts the flags, seen by building a small program with them."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "probe.c")
        source.write_text(
            "int main(void) { int s = 0;\n#pragma omp parallel for\nfor (int i = 0; i < 2; i++) s |= i; return 0; }\n"
        )
        command = [*compiler, str(source), "-o", str(Path(folder, "probe")), *flags]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0


class BuildPython(build_py):
    """Adds the examples, which are beside the package in the repository and inside it in a wheel."""

    def run(self):
        """Copy the settings files and scripts; an editable installation finds them where they are."""
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib, "apt_evap", "examples")
            self.mkpath(str(target))
            for path in sorted(Path("examples").iterdir()):
                if path.suffix in (".py", ".toml"):
                    self.copy_file(str(path), str(target))


class BuildCore(build_ext):
    """Adds the flags that the compiler at hand understands."""

    def finalize_options(self):
        """Prefer GCC to Microsoft's compiler."""
        super().finalize_options()
        if sys.platform == "win32" and self.compiler is None and shutil.which("gcc"):
            self.compiler = "mingw32"

    def get_libraries(self, ext):
        """Link with the library of all Pythons for the limited API, of which setuptools knows nothing on Windows."""
        libraries = super().get_libraries(ext)
        return [re.sub(r"^python3\d+$", "python3", name) for name in libraries] if ABI3 else libraries

    def build_extensions(self):
        """Probe for OpenMP, with a serial build and one warning if there is none; leave out debug symbols."""
        if self.compiler.compiler_type == "msvc":
            raise SystemExit(
                "the compiler of apt_evap must be GCC, such as that of MSYS2 (UCRT64) with gcc.exe in the PATH, got "
                "Microsoft's"
            )
        compiler = getattr(self.compiler, "compiler", None)
        if compiler:
            openmp, link = [], []
            if not os.environ.get("APT_EVAP_SERIAL"):
                for openmp, link in OPENMP:
                    if compiles(compiler, [*openmp, *link]):
                        break
                else:
                    openmp, link = [], []
                    warnings.warn("the compiler has no OpenMP: apt_evap is built for one thread", stacklevel=1)
            simd = ["-fopenmp-simd"] if not openmp and compiles(compiler, ["-fopenmp-simd"]) else []
            # debug symbols, which Python's own -g asks for, are four fifths of the size; with -g in CFLAGS they stay
            wanted = "-g" in os.environ.get("CFLAGS", "").split()
            bare = ["-g0"] if not wanted and compiles(compiler, ["-g0"]) else []
            for extension in self.extensions:
                extension.extra_compile_args = [*FLAGS, *openmp, *simd, *bare]
                extension.extra_link_args = [*link]
        self.parallel = self.parallel or os.cpu_count()
        super().build_extensions()


extensions = [
    Extension(
        f"apt_evap._core.{name}",
        [f"apt_evap/_core/{name}.pyx"],
        depends=sorted(str(path) for path in Path("apt_evap/_core").glob("*.h")),
        include_dirs=["apt_evap/_core"],
        define_macros=MACROS,
        py_limited_api=ABI3,
        libraries=[] if platform.system() == "Windows" else ["m"],
    )
    for name in MODULES
]
setup(
    ext_modules=cythonize(
        extensions,
        build_dir="build/cython" + "-bounds" * BOUNDS + "-abi3" * ABI3,  # their objects differ
        compiler_directives=DIRECTIVES,
        quiet="-q" in sys.argv,
    ),
    options={"bdist_wheel": {"py_limited_api": "cp311"}} if ABI3 else {},
    cmdclass={"build_ext": BuildCore, "build_py": BuildPython},
)
