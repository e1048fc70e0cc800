#!/usr/bin/env bash
# Make .venv and install the project with its development tools, or say that the one there is still right.
set -euo pipefail
cd "$(dirname "$0")/.."

stamp=.venv/.openspm-setup
# A virtual environment is bound to its folder, so a moved checkout is set up anew.
key="$(cksum <pyproject.toml) $PWD"

# The interpreter that the present .venv was made from, or nothing where there is none that works.
base=
if [ -x .venv/bin/python ]; then
  base=$(PYTHON=.venv/bin/python scripts/find_python.sh 2>/dev/null) || true
fi
# PYTHON=... is looked at even when .venv exists: naming another one, or a broken one, has to have a consequence.
if [ -z "$base" ] || [ -n "${PYTHON:-}" ]; then
  wanted=$(scripts/find_python.sh)
else
  wanted=$base
fi

if [ "$wanted" = "$base" ] && [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$key" ]; then
  echo "set-up: .venv is up to date, reused"
  exit 0
fi

started_s=$SECONDS
rm -f "$stamp"
if [ "$wanted" = "$base" ]; then
  echo "set-up: .venv is there, bringing it up to pyproject.toml"
else
  echo "set-up: making .venv with $("$wanted" --version)"
  "$wanted" -m venv --clear .venv
fi

echo "set-up: installing lerobot_policy_openspm and its dependencies (some GB the first time)"
if command -v uv >/dev/null 2>&1; then
  uv pip install --python .venv/bin/python --editable '.[dev]'
else
  # Of what pip says, the big downloads and the installing: the progress that takes time. Errors come on stderr.
  .venv/bin/python -m pip install --no-input --disable-pip-version-check --editable '.[dev]' \
    | sed -n -e '/^ *Downloading .* [MG]B)/p' -e 's/^Installing collected packages:.*/  Installing/p'
fi

echo "$key" >"$stamp"
echo "set-up: done in $((SECONDS - started_s)) s"
