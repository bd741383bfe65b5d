#!/usr/bin/env bash
# Make .venv with the dependencies of pyproject.toml, those of training, live view and tests
# included, and OpenVINO, on which networks are fastest, where this machine has a wheel of it.
# The repository is installed as it lies there: `import lightfield_events` works in any folder.
set -euo pipefail
cd "$(dirname "$0")/.."

"${PYTHON:-python3}" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || {
  echo "Python 3.11, 3.12 or 3.13 is needed; name it with PYTHON=..." >&2
  exit 2
}
"${PYTHON:-python3}" -m venv .venv
pip=(.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt)

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
extras = project["optional-dependencies"]
print(*project["dependencies"], *extras["train"], *extras["live"], *extras["test"], sep="\n")
PY
"${pip[@]}" --requirement .venv/requirements.txt

openvino=$(sed -n 's/^openvino = \["\(.*\)"\].*/\1/p' pyproject.toml)
"${pip[@]}" --only-binary=:all: "$openvino" ||
  echo "OpenVINO is not there (no wheel for this machine?): networks run in PyTorch, slower" >&2

"${pip[@]}" --no-deps --no-build-isolation --editable .

# On all cores, where pip compiles file after file; some are of other versions of Python.
.venv/bin/python -m compileall -qq -j 0 .venv/lib || true
