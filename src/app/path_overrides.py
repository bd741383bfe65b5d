"""Paths on the command line, as they were typed: `recording=größe (1).txt` needs no quotes.

Hydra's grammar would refuse such names, or take `2026_11_26` for the number 20261126.  So the
values of keys that name files are quoted before Hydra sees them.
"""

import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

# Keys whose values are files, folders, weights or free text; of a dotted key its last word.
PATH_KEYS = frozenset({
    "against", "allowed_origins", "backbone_weights", "cache_root", "ckpt", "corners",
    "distillation_cache", "export", "footage", "into", "like", "measured", "name", "names",
    "offered_networks", "out", "photo", "postprocessor", "published", "recording",
    "reference_images", "root", "run", "save", "save_dir", "teachers", "title",
    "extra_train_root", "video", "video_root", "videos", "weights", "write",
})  # fmt: skip
WHOLE_KEYS = frozenset({
    "hydra.run.dir", "hydra.sweep.dir", "views", "calibrate:still", "train:start",
})  # fmt: skip
MAY_BE_EMPTY = ("name", "title")  # free text
SWEEP_FUNCTION = re.compile(r"(choice|range|interval|glob|sort|shuffle|tag)\s*\(.*\)", re.DOTALL)
MAX_FOLDER_BYTES = 60
QUOTED = re.compile(r"""'([^'\\]|\\.)*'|"([^"\\]|\\.)*\"""", re.DOTALL)


def quote_paths(arguments: Sequence[str], entry_point: str) -> list[str]:
    """Return the command line of an entry point with the values of paths quoted, and `.inf`, as a
    config has it, as Hydra reads it.

    `~` is the user's folder.  What is quoted already, null, and `${...}` keep their meaning; in a
    list, and in a sweep (-m), a comma separates, so that a comma in a name needs quotes there.
    """
    sweep = _is_sweep(arguments)
    return [_quote_argument(argument, entry_point, sweep) for argument in arguments]


def unquote(value: str) -> str:
    """Return the text of a quoted value, any other as it is."""
    if not QUOTED.fullmatch(value):
        return value
    return re.sub(rf"(\\+)(?={value[0]}|$)", lambda f: f[1][: len(f[1]) // 2], value[1:-1])


def unquote_override(override: str) -> str:
    """Return `key=value` with the value as `quote_paths` found it."""
    key, equals, value = override.partition("=")
    return f"{key}{equals}{unquote(value)}"


def is_path_key(key: str, entry_point: str) -> bool:
    """Return whether the values of a config key are paths."""
    return key.split(".")[-1] in PATH_KEYS or not {key, f"{entry_point}:{key}"}.isdisjoint(
        WHOLE_KEYS
    )


def refuse_empty_paths(arguments: Iterable[str], entry_point: str) -> None:
    """Raise ValueError for a path without a letter, as an unset variable of the shell gives it;
    before Hydra, which would make the folder of the run at the root of the disk.
    """
    for argument in arguments:
        key, equals, value = argument.lstrip("+").partition("=")
        may_be_empty = not is_path_key(key, entry_point) or key.split(".")[-1] in MAY_BE_EMPTY
        if equals and unquote(value.strip()) == "" and not may_be_empty:
            raise ValueError(f"{key} must be a path, got ''")


def _quote_argument(argument: str, entry_point: str, sweep: bool) -> str:
    key, equals, value = argument.partition("=")
    if argument.startswith("-") or not equals:
        return argument
    if not is_path_key(key.lstrip("+"), entry_point):
        return f"{key}=inf" if value.strip().lower() == ".inf" else argument
    values = _split(value) if sweep else [value]
    return f"{key}={','.join(map(_quote, values))}"


def _quote(value: str) -> str:
    text = value.strip()
    if text in ("", "null", "???") or QUOTED.fullmatch(text) or SWEEP_FUNCTION.fullmatch(text):
        return value
    if text[0] == "[" and text[-1] == "]":
        return f"[{','.join(map(_quote, _split(text[1:-1])))}]"
    if value[0] == "~":
        value = str(Path(value).expanduser())
    # A backslash is one, but before a quote or the end.
    escaped = re.sub(r"(\\*)('|$)", lambda found: found[1] * 2 + ("\\'" if found[2] else ""), value)
    return f"'{escaped}'"


def _split(values: str) -> Iterator[str]:
    """Yield the values between the commas that stand in no quotes and no brackets."""
    start = place = depth = 0
    while place < len(values):
        letter = values[place]
        quoted = QUOTED.match(values, place) if values[start:place].strip(" [") == "" else None
        if quoted:
            place = quoted.end()
            continue
        depth += (letter in "[(") - (letter in "])")
        if letter == "," and depth <= 0:
            yield values[start:place].strip()
            start = place + 1
        place += 1
    yield values[start:].strip()


def _is_sweep(arguments: Sequence[str]) -> bool:
    """Return whether Hydra runs several jobs: by -m, hydra.mode or the config that is named."""
    if {"-m", "--multirun", "hydra.mode=MULTIRUN"} & set(arguments):
        return True
    options = dict(pairwise([*arguments, ""]))
    options |= dict(a.split("=", 1) for a in arguments if re.match("--config-(dir|name)=", a))
    folder = options.get("--config-dir") or options.get("-cd")
    name = options.get("--config-name") or options.get("-cn")
    file = Path(folder or "conf") / f"{str(name).removesuffix('.yaml')}.yaml"
    return bool(name) and file.is_file() and "MULTIRUN" in file.read_text(encoding="utf-8")


def _as_typed(value: str) -> str:
    """Return a value without its quotes, and without those of plain words in a list."""
    if value[:1] == "[":
        return re.sub(r"'([\w.+-]*)'", r"\1", value)
    return unquote(value)


def name_job_folder(overrides: Iterable[str]) -> str:
    """Return the overrides of a sweep's job as the name of one folder, at most MAX_FOLDER_BYTES:
    `experiment-lf3x3_seed-0`, without quotes, so that it may be given as ckpt= without quotes.

    Longer ones have the last words of the keys, the values alone, or their ends.  Different
    overrides have different names: where a name could stand for others too, or is not whole, a hash
    of the overrides ends it.
    """
    given = [override.partition("=")[::2] for override in sorted(overrides)]
    pairs = [(key, _as_typed(value)) for key, value in given if key != "paths.out"]
    shown = [(key, re.sub("['\"]", "", value)) for key, value in pairs]
    name = _join_for_folder(f"{key}={value}" for key, value in shown)
    others = any(f"_{key}" in value for _, value in pairs for key, _ in pairs)
    signs = any(sign in value for _, value in pairs for sign in "/=\\\n'\"")
    if not (others or signs or len(name.encode()) > MAX_FOLDER_BYTES):
        return name
    shorter = _join_for_folder(f"{key.split('.')[-1]}={value}" for key, value in shown)
    lengths = (250, 40, 20, 10, 5)
    ends = (_join_for_folder(_cut(value, most) for _, value in shown) for most in lengths)
    room = MAX_FOLDER_BYTES - 9
    fitting = (text for text in (name, shorter, *ends) if len(text.encode()) <= room)
    kept = next(fitting, name.encode()[:room].decode(errors="ignore"))
    return f"{kept}_{hashlib.sha256(repr(pairs).encode()).hexdigest()[:8]}"


def _cut(value: str, most: int) -> str:
    """Return the end of a value, without the brackets of a list where it is not whole."""
    return value if len(value) <= most else value.strip("[]")[-most:]


def _join_for_folder(texts: Iterable[str]) -> str:
    return re.sub(r"[/=\\\n]", "-", "_".join(texts)).lstrip("-.")
