#!/bin/sh
# Runs the test suite with the oldest versions that pyproject.toml allows (constraints-oldest.txt), then with the newest
# available, each in its own environment under .venvs/ (about 8 GB each). make test uses constraints.txt, which lies in
# between. Optional arguments select the set and the tests:
#   sh tools/oldest_and_newest.sh [oldest|newest|both] [TEST ...]
set -eu
cd "$(dirname "$0")/.."
sets=${1:-both}
[ $# = 0 ] || shift
[ "$sets" = both ] && sets="oldest newest"
failed=""
for set in $sets; do
    venv=.venvs/$set
    case $set in
        oldest) constraints=constraints-oldest.txt pythons="python3.10 python3.11 python3.12" ;;
        newest) constraints=/dev/null pythons="python3.12 python3.11 python3.10" ;;
        *) echo "error: $set is no set, expected oldest, newest or both" >&2; exit 2 ;;
    esac
    if [ ! -f "$venv/.installed" ] || [ pyproject.toml -nt "$venv/.installed" ] || [ constraints-oldest.txt -nt "$venv/.installed" ]; then
        rm -rf "$venv"
        PYTHON=${PYTHON:-$pythons} sh tools/setup.sh "$venv" "$constraints"
        touch "$venv/.installed"
    fi
    echo "== $set: $("$venv/bin/python" -c 'import sys, numpy, scipy, torch; print(f"Python {sys.version.split()[0]}, torch {torch.__version__}, numpy {numpy.__version__}, scipy {scipy.__version__}")')"
    PATH="$(pwd)/$venv/bin:$PATH" "$venv/bin/python" -m pytest -m "not slow and not gpu" "${@:-tests}" || failed="$failed $set"
done
[ -z "$failed" ] || { echo "failed with:$failed" >&2; exit 1; }
