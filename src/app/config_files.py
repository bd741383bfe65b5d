"""Where the configs lie, and the choices of their groups."""

from pathlib import Path

CONF = str(Path(__file__).resolve().parents[2] / "conf")


def config_choices(group: str) -> list[str]:
    """Return the names of the configs of a group such as turbulence."""
    return sorted(file.stem for file in (Path(CONF) / group).glob("*.yaml"))
