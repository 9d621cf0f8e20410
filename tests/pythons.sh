#!/usr/bin/env bash
# What needs no torch, on other Pythons than that of the environment: `bash tests/pythons.sh all 3.12 3.13`.
#
#   world WHEEL LOG PYTHON…   the core of a wheel runs the world of a log once more: the same bits
#   all PYTHON…               core, gains and studies without learners: their tests
#
# A Python that this machine does not have, or not whole, is named and left out. PyPI's torch for it brings several gigabytes of GPU
# libraries, so learners are tested on one Python alone.
set -euo pipefail

root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"

# Its path, or nothing: one that cannot make environments is none. A name in the search path may be a pyenv shim, which runs only what it is told to.
interpreter() {
  PYENV_VERSION="$1" "python$1" -c 'import ensurepip, sys, venv; print(sys.executable)' 2>/dev/null || true
}

# In an environment with requirements.
make_environment() {
  local folder=$1 python=$2
  shift 2
  test -x "$folder/bin/python" || "$python" -m venv "$folder"
  "$folder/bin/python" -m pip install --quiet -c "$root/constraints.txt" "$@"
}

# Every requirement of the extra dev but torch and what brings it.
without_torch() {
  "$1" - "$root/pyproject.toml" <<'PYTHON'
import re, sys, tomllib

with open(sys.argv[1], "rb") as stream:
    extras = tomllib.load(stream)["project"]["optional-dependencies"]

def requirements(extra):
    for requirement in extras[extra]:
        inner = re.fullmatch(r"hiersched\[(.+)\]", requirement)
        for name in inner[1].split(",") if inner else ():
            yield from requirements(name.strip())
        if not inner and not requirement.startswith(("torch", "stable-baselines3")):
            yield requirement

print(*dict.fromkeys(requirements("dev")), sep="\n")
PYTHON
}

world() {
  local version=$1 python=$2 wheel=$3 log=$4
  work="$(mktemp -d)"
  trap 'rm -rf "$work"' EXIT
  make_environment "$work/venv" "$python" "$wheel"
  (cd "$work" && "$work/venv/bin/hiersched" replay "$log")
  rm -rf "$work"
  echo "Python $version: the core's world is the same, bit for bit"
}

all() {
  local version=$1 python=$2
  local folder="$root/.venv-$version" requirements
  mapfile -t requirements < <(without_torch "$python")
  make_environment "$folder" "$python" "${requirements[@]}" -e "$root"
  (cd "$root" && "$folder/bin/python" -m pytest -q -n "${CORES:-2}" --dist loadgroup)
  echo "Python $version: all tests that need no torch passed"
}

mode=$1
shift
given=()
if [ "$mode" = world ]; then
  given=("$(realpath "$1")" "$(realpath "$2")")
  shift 2
fi
for version in "$@"; do
  python="$(interpreter "$version")"
  if [ -z "$python" ]; then
    echo "Python $version: not on this machine, not tested"
  else
    "$mode" "$version" "$python" "${given[@]}"
  fi
done
