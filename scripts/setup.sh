#!/usr/bin/env bash
# Make .venv with the dependencies of pyproject.toml (those of the tests included).
# The repository itself is run from its root and not installed.
set -euo pipefail
cd "$(dirname "$0")/.."

"${PYTHON:-python3}" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || {
  echo "Python 3.11, 3.12 or 3.13 is needed; name it with PYTHON=..." >&2
  exit 2
}
"${PYTHON:-python3}" -m venv .venv
pip=(.venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt)

# Without a GPU a plain torch would bring gigabytes of CUDA; the +cpu build is asked for by name,
# first from where pip is set up to look, then from PyTorch's own index.
torch=2.13.0
if command -v nvidia-smi >/dev/null; then
  "${pip[@]}" "torch==$torch"
else
  "${pip[@]}" "torch==$torch+cpu" 2>/dev/null ||
    "${pip[@]}" --extra-index-url https://download.pytorch.org/whl/cpu "torch==$torch+cpu"
fi

.venv/bin/python - >.venv/requirements.txt <<'PY'
import tomllib

project = tomllib.load(open("pyproject.toml", "rb"))["project"]
print(*project["dependencies"], *project["optional-dependencies"]["test"], sep="\n")
PY
"${pip[@]}" --requirement .venv/requirements.txt
