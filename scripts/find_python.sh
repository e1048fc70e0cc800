#!/usr/bin/env bash
# Print the path of a Python 3.12 or 3.13 that can make a virtual environment; say on stderr what to install otherwise.
#
# Every candidate is run: a name on PATH proves nothing, since pyenv puts a shim there for every version it ever
# installed and most of them fail when called. PYTHON=/path/to/python names one candidate and no other is tried.
set -euo pipefail

probe_code='
import sys, venv, ensurepip
if not (3, 12) <= sys.version_info[:2] <= (3, 13):
    sys.exit(3)
# The base interpreter: a virtual environment made from another one dies with it.
print(sys._base_executable)
'

# Prints the interpreter behind "$1", or fails without a word.
probe() {
  "$1" -c "$probe_code" 2>/dev/null </dev/null
}

if [ -n "${PYTHON:-}" ]; then
  if probe "$PYTHON"; then
    exit 0
  fi
  {
    echo "PYTHON=$PYTHON cannot be used: it must run, be Python 3.12 or 3.13, and have the modules venv and ensurepip."
    echo "It says: $("$PYTHON" --version 2>&1 </dev/null | head -n 1 || true)"
  } >&2
  exit 1
fi

candidates=()
if command -v uv >/dev/null 2>&1; then
  # --system: not the virtual environment that may be active or lie in this folder.
  found=$(uv python find --system '>=3.12,<3.14' 2>/dev/null </dev/null) && candidates+=("$found")
fi
candidates+=(python3.12 python3.13 python3 python)
pyenv=${PYENV_ROOT:-$HOME/.pyenv}
for pattern in "$pyenv"/versions/3.12*/bin/python3.12 "$pyenv"/versions/3.13*/bin/python3.13; do
  [ -x "$pattern" ] && candidates+=("$pattern")
done

for candidate in "${candidates[@]}"; do
  if probe "$candidate"; then
    exit 0
  fi
done

cat >&2 <<'MESSAGE'
No working Python 3.12 or 3.13 with the modules venv and ensurepip was found. Install one of these ways:
  uv      curl -LsSf https://astral.sh/uv/install.sh | sh && uv python install 3.12
  apt     sudo apt-get install python3.12 python3.12-venv     (Ubuntu 24.04; Debian 13 has python3.13 python3.13-venv)
  pyenv   pyenv install 3.12
  brew    brew install python@3.12
or name one: make setup PYTHON=/path/to/python3.12
MESSAGE
exit 1
