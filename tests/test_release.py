"""One version and one licence, wherever they are stated."""

import tomllib

import yaml

from tests.conftest import ROOT


def test_version_licence_and_changelog_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert project["version"] == citation["version"] and project["name"] == citation["title"]
    assert project["license"] == citation["license"] == "MIT"
    newest = next(
        line for line in (ROOT / "CHANGELOG.md").read_text().splitlines() if line.startswith("## ")
    )
    assert newest == f"## {project['version']} ({citation['date-released']})"
