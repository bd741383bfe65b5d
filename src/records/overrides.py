"""The overrides of a command line, as they are typed and as runs store them."""


def read_override_key(override: str) -> str:
    """Return the key, or the group, of `key=value`, `+key=value`, `~key`, `group@package=name`."""
    return override.partition("=")[0].strip().lstrip("+~").partition("@")[0]
