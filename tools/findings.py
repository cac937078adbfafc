"""Reads the logs of a checker, prints the findings that have to do with the compiled core, and fails if there are any.

Python, NumPy and SciPy leave some memory behind when they end; a leak is the core's if a function of the core is among
the callers, the loading of its modules excepted.
"""

import re
import sys
from pathlib import Path

CORE = re.compile(r"apt_evap/_core/\w+\.")
LOADING = re.compile(r"__pyx_pymod_exec|PyInit_|__Pyx_InitConstants|__Pyx_CreateStringTabAndInitStrings")
LEAK = re.compile(r"leak of|(?:definitely|indirectly) lost|are possibly lost|still reachable in loss")
ERROR = re.compile(
    r"ERROR: AddressSanitizer|runtime error:|WARNING: ThreadSanitizer|uninitialised|Invalid (?:read|write|free)"
    r"|Mismatched free|overlap in"
)
FRAME = re.compile(r"^\s*(?:#\d+|at|by)\b")


def paragraphs(text):
    """Paragraphs of a log, without the process numbers that valgrind puts in front of its lines."""
    text = re.sub(r"^(?:==|--)\d+(?:==|--) ?", "", text, flags=re.MULTILINE)
    return [part for part in re.split(r"\n\s*\n", text) if part.strip()]


def concerns_the_core(paragraph):
    """Whether a finding is one, and of the core."""
    frames = "\n".join(line for line in paragraph.splitlines() if FRAME.match(line))
    if LEAK.search(paragraph):
        return bool(CORE.search(frames)) and not LOADING.search(frames)
    return bool(ERROR.search(paragraph)) and bool(CORE.search(paragraph))


def main():
    """Print what concerns the core."""
    read = found = 0
    for path in map(Path, sys.argv[1:]):
        if path.is_file():
            for paragraph in paragraphs(path.read_text(errors="replace")):
                read += bool(LEAK.search(paragraph) or ERROR.search(paragraph))
                if concerns_the_core(paragraph):
                    found += 1
                    print(paragraph, end="\n\n")
    print(f"{read} findings in the logs, {found} of the core")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
