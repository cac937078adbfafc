#!/usr/bin/env bash
# The compiled core under a checker; what is built goes to build/KIND and the package in the source tree stays as it is.
#
#   tools/sanitize.sh address    reads and writes outside of memory, undefined behaviour, leaks of the core (GCC)
#   tools/sanitize.sh bounds     every index of every typed memoryview against its length
#   tools/sanitize.sh thread     races (needs clang, its OpenMP runtime and Archer: clang-19 libomp-19-dev of Debian)
#   tools/sanitize.sh valgrind   reads of memory that was never written, leaks of the core (needs valgrind; slow)
#
# More words are given to pytest in place of the tests named here. It needs what '.[test]' installs, and says at the
# end "sanitize KIND: nothing found"; its exit code is not 0 if something was.
set -euo pipefail
cd "$(dirname "$0")/.."
kind=${1:?"say which: address, bounds, thread or valgrind"}
shift
tests=("$@")
core=(tests/_core tests/flight)
build=$PWD/build/$kind
log=$build/found
mkdir -p "$build"
rm -f "$log"*

build_core() { # with the environment it is given, into a folder of its own
    env "$@" python setup.py -q build --build-base "$build" --build-lib "$build/lib" --force
}
run() { # a command that imports the package from there
    env PYTHONSAFEPATH=1 PYTHONPATH="$build/lib" "$@"
}
preload() { # so that the checker is there before Python is
    echo "LD_PRELOAD=$1"
}
finish() {
    if [ "$1" -ne 0 ]; then
        echo "sanitize $kind: FOUND SOMETHING (or the tests failed), see above and $log*"
        exit 1
    fi
    echo "sanitize $kind: nothing found"
}

status=0
case $kind in
address)
    flags="-fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -g"
    build_core CC=gcc CFLAGS="$flags"
    # PYTHONMALLOC: arrays of Python and NumPy then lie between guarded bytes
    run "$(preload "$(gcc -print-file-name=libasan.so) $(gcc -print-file-name=libubsan.so)")" PYTHONMALLOC=malloc \
        ASAN_OPTIONS="log_path=$log:exitcode=0:detect_leaks=1:malloc_context_size=12" UBSAN_OPTIONS=print_stacktrace=1 \
        LSAN_OPTIONS="exitcode=0:fast_unwind_on_malloc=0:max_leaks=0" \
        python -m pytest -q -p no:cacheprovider "${tests[@]:-${core[@]}}" || status=1
    python tools/findings.py "$log"* || status=1
    ;;
bounds)
    build_core APT_EVAP_BOUNDS=1
    # an index out of range in a function that cannot raise is printed by Python, and pytest warns of it
    run python -m pytest -q -p no:cacheprovider -W error::pytest.PytestUnraisableExceptionWarning \
        "${tests[@]:-${core[@]}}" || status=1
    ;;
thread)
    llvm=$(dirname "$(readlink -f "$(command -v "${CLANG:-clang-19}")")")/..
    runtime=$("${CLANG:-clang-19}" -print-file-name=libclang_rt.tsan-x86_64.so)
    build_core CC="${CLANG:-clang-19}" CFLAGS="-fsanitize=thread -g -fno-omit-frame-pointer" \
        LDSHARED="${CLANG:-clang-19} -shared -shared-libsan"
    # Archer tells the checker what OpenMP's barriers and locks order; libomp itself is not instrumented
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
    echo "no checker is called '$kind': address, bounds, thread or valgrind"
    exit 2
    ;;
esac
finish $status
