#!/usr/bin/env bash
# Build the source archive and the wheel, and run the tests in a new environment, as installed by a user.
#
#   tools/check_dist.sh [arguments of pytest]      default: all tests; one or two files are faster
#
# With APT_EVAP_SERIAL=1, the core is built and tested without OpenMP.
set -euo pipefail
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

python3 -m venv "$work/builder"
"$work/builder/bin/pip" -q install build
"$work/builder/bin/python" -m build --outdir "$work/dist" . >"$work/log" 2>&1 || { cat "$work/log"; exit 1; }
archive=$(echo "$work"/dist/*.tar.gz)
wheel=$(echo "$work"/dist/*.whl)

python3 - "$archive" "$wheel" <<'PYTHON'
import sys, tarfile, zipfile
from pathlib import PurePosixPath as Path

archive = {"/".join(Path(name).parts[1:]) for name in tarfile.open(sys.argv[1]).getnames()}
wheel = set(zipfile.ZipFile(sys.argv[2]).namelist())
modules = {Path(name).stem for name in archive if name.startswith("apt_evap/_core/") and name.endswith(".pyx")}
python = {name for name in archive if name.startswith("apt_evap/") and name.endswith((".py", ".pyi"))}
wrong = []
wrong += [f"the archive lacks {name}" for name in ("LICENSE", "README.md", "setup.py", "tests/conftest.py", "docs/api.rst",
          "apt_evap/_core/kernels.h", "apt_evap/_core/octree.pxd", "apt_evap/py.typed") if name not in archive]
wrong += [f"the archive has {name}" for name in archive if name.endswith((".so", ".c")) or name.startswith("build/")]
wrong += [f"the wheel lacks {name}" for name in python | {"apt_evap/py.typed"} if name not in wheel]
for module in modules:
    start = f"apt_evap/_core/{module}."
    compiled = any(name.startswith(start) and name.endswith((".so", ".pyd")) for name in wheel)
    wrong += [] if compiled else [f"the wheel lacks the compiled {module}"]
examples = {name for name in archive if name.startswith("examples/") and name.endswith((".py", ".toml"))}
wrong += [f"the wheel lacks {name}" for name in examples if f"apt_evap/{name}" not in wheel]
wrong += [] if examples else ["the archive lacks the examples"]
wrong += [f"the wheel has {name}" for name in wheel if name.endswith((".pyx", ".pxd", ".c", ".h"))]
wrong += [f"the wheel has {name}" for name in wheel if not name.startswith(("apt_evap/", "apt_evap-"))]
if not modules or wrong:
    sys.exit("\n".join(wrong) or "no modules found")
print(f"{len(archive)} names in the archive, {len(wheel)} in the wheel")
PYTHON

python3 -m venv "$work/fresh"
"$work/fresh/bin/pip" -q install "${wheel}[test]"
mkdir "$work/source"
tar -xzf "$archive" -C "$work/source" --strip-components=1
cd "$work/source"
"$work/fresh/bin/python" -P - <<'PYTHON'
import os, apt_evap, apt_evap._core.interactions as interactions
assert "site-packages" in apt_evap.__file__, apt_evap.__file__
needs_openmp = b"GOMP_" in open(interactions.__file__, "rb").read()
print("the core was built", "with" if needs_openmp else "without", "OpenMP")
assert not (needs_openmp and os.environ.get("APT_EVAP_SERIAL"))
PYTHON
"$work/fresh/bin/pytest" -q "$@"
