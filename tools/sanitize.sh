#!/usr/bin/env bash
# Run the compiled core with a checker. The build goes to build/KIND; the package in the source tree is not changed.
#
#   tools/sanitize.sh address    invalid reads and writes, undefined behaviour, memory leaks of the core (GCC)
#   tools/sanitize.sh bounds     bounds checks of every index of every typed memoryview
#   tools/sanitize.sh thread     data races (needs clang, its OpenMP runtime and Archer: clang-19 libomp-19-dev on Debian)
#   tools/sanitize.sh valgrind   reads of uninitialised memory, memory leaks of the core (needs valgrind; slow)
#
# Further arguments are passed to pytest instead of the default tests. The script needs the packages of '.[test]'. At the
# end it prints "sanitize KIND: nothing found"; otherwise its exit code is not 0.
set -euo pipefail
cd "$(dirname "$0")/.."
kind=${1:?"must be address, bounds, thread or valgrind"}
shift
tests=("$@")
core=(tests/_core tests/simulation/test_flights.py tests/simulation/test_response.py
      tests/simulation/test_rules_by_response.py tests/simulation/test_field_of_view.py)
build=$PWD/build/$kind
log=$build/findings
mkdir -p "$build"
rm -f "$log"*

build_core() { # with the given environment variables, into a separate folder
    env "$@" python setup.py -q build --build-base "$build" --build-lib "$build/lib" --force
}
run() { # run a command that imports the package from this folder
    env PYTHONSAFEPATH=1 PYTHONPATH="$build/lib" "$@"
}
preload() { # load the checker before Python starts
    echo "LD_PRELOAD=$1"
}
finish() {
    if [ "$1" -ne 0 ]; then
        echo "sanitize $kind: ERRORS FOUND, or tests failed; see above and $log*"
        exit 1
    fi
    echo "sanitize $kind: nothing found"
}

status=0
case $kind in
address)
    flags="-fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -g"
    build_core CC=gcc CFLAGS="$flags"
    # PYTHONMALLOC: guard bytes around arrays of Python and NumPy
    run "$(preload "$(gcc -print-file-name=libasan.so) $(gcc -print-file-name=libubsan.so)")" PYTHONMALLOC=malloc \
        ASAN_OPTIONS="log_path=$log:exitcode=0:detect_leaks=1:malloc_context_size=12" UBSAN_OPTIONS=print_stacktrace=1 \
        LSAN_OPTIONS="exitcode=0:fast_unwind_on_malloc=0:max_leaks=0" \
        python -m pytest -q -p no:cacheprovider "${tests[@]:-${core[@]}}" || status=1
    python tools/findings.py "$log"* || status=1
    ;;
bounds)
    build_core APT_EVAP_BOUNDS=1
    # if a function cannot raise an exception, Python prints an index error, and pytest issues a warning
    run python -m pytest -q -p no:cacheprovider -W error::pytest.PytestUnraisableExceptionWarning \
        "${tests[@]:-${core[@]}}" || status=1
    ;;
thread)
    llvm=$(dirname "$(readlink -f "$(command -v "${CLANG:-clang-19}")")")/..
    runtime=$("${CLANG:-clang-19}" -print-file-name=libclang_rt.tsan-x86_64.so)
    build_core CC="${CLANG:-clang-19}" CFLAGS="-fsanitize=thread -g -fno-omit-frame-pointer" \
        LDSHARED="${CLANG:-clang-19} -shared -shared-libsan"
    # Archer informs the checker about the barriers and locks of OpenMP; libomp itself is not instrumented
    printf 'called_from_lib:libomp.so\n' >"$build/suppressions"
    run "$(preload "$runtime")" OMP_TOOL_LIBRARIES="$llvm/lib/libarcher.so" OPENBLAS_NUM_THREADS=1 \
        TSAN_OPTIONS="log_path=$log:exitcode=0:history_size=4:suppressions=$build/suppressions" \
        LD_LIBRARY_PATH="$llvm/lib" setarch -R python tools/workout.py 200 4 || status=1
    python tools/findings.py "$log"* || status=1
    ;;
valgrind)
    build_core CFLAGS=-g
    run PYTHONMALLOC=malloc OPENBLAS_NUM_THREADS=1 OMP_WAIT_POLICY=passive valgrind --log-file="$log" --leak-check=full --show-leak-kinds=definite \
        --num-callers=30 --fullpath-after= python tools/workout.py 8 2 || status=1
    python tools/findings.py "$log"* || status=1
    ;;
*)
    echo "unknown checker '$kind': must be address, bounds, thread or valgrind"
    exit 2
    ;;
esac
finish $status
