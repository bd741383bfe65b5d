"""Every probe on every network: findings, a table of them, and in plain words where each breaks."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from src.bench.candidates import Candidate, Subject
from src.bench.probes.standard import Bench, Finding
from src.records.results import csv_text

Probe = Callable[[Subject, Bench], Finding]
Cell = Finding | str  # or why there is none
Found = dict[str, dict[str, Cell]]  # probe -> network -> cell


@dataclass(frozen=True)
class Account:
    """What was found out about one network: a cell for every probe, the aligned PSNR in dB where
    nothing is made hard (None: it does not run), and how long it took.
    """

    network: str
    cells: dict[str, Cell]
    standard: float | None
    seconds: float


def examine(candidate: Candidate, probes: Mapping[str, Probe], bench: Bench) -> Account:
    """Put a network through the probes; one that cannot run leaves the reason for a finding."""
    start = time.perf_counter()
    cells = {name: _cell(candidate, probe, bench) for name, probe in probes.items()}
    standard = None
    if candidate.network is not None and candidate.trained:
        standard = bench.standard(Subject(candidate.name, candidate.network, candidate.views))
    return Account(candidate.name, cells, standard, time.perf_counter() - start)


def gather(accounts: Iterable[Account], keep: Callable[[Found], None]) -> tuple[Found, dict]:
    """Return every cell, probe by probe, and the standard of every network that has one.

    `keep` is called with what is found so far after every network.
    """
    findings: Found = {}
    standards: dict[str, float] = {}
    for account in accounts:
        for probe, cell in account.cells.items():
            findings.setdefault(probe, {})[account.network] = cell
        if account.standard is not None:
            standards[account.network] = account.standard
        keep(findings)
        print(f"{account.network}: {account.seconds:.0f} s", flush=True)
    return findings, standards


def _cell(candidate: Candidate, probe: Probe, bench: Bench) -> Cell:
    if candidate.network is None:
        return candidate.missing
    if not candidate.trained:
        return f"it has no weights: {candidate.missing}"
    if candidate.restorer is not None:
        return "a post-processor wants the whole video"
    try:
        return probe(Subject(candidate.name, candidate.network, candidate.views), bench)
    except ValueError as error:
        return str(error)


def table(findings: Found, titles: Mapping[str, str]) -> str:
    """Return CSV: one line for the value of each cell and for each point of its curve."""
    heads, lines = "network probe title varied setting value unit limit failed reason", []
    for probe, cells in findings.items():
        for network, cell in cells.items():
            lines += _lines(network, probe, titles[probe], cell)
    return csv_text(heads.split(), lines)


def _lines(network: str, probe: str, title: str, cell: Cell) -> list[list]:
    head = [network, probe, title]
    if isinstance(cell, str):
        return [[*head, "", "", "", "", "", "", cell]]
    tail = [cell.unit, cell.limit]
    points = [
        [*head, cell.varied, setting, f"{value:.6g}", *tail, cell.fails(value), ""]
        for setting, value in cell.curve
    ]
    return [[*head, "", "", f"{cell.value:.6g}", *tail, cell.failed, ""], *points]


def words(findings: Found, titles: Mapping[str, str], standards: Mapping[str, float]) -> str:
    """Return, in plain words, where each network breaks."""
    networks = list(next(iter(findings.values()), {}))
    parts = ["# Where each method breaks\n"]
    for network in networks:
        cells = {titles[probe]: row[network] for probe, row in findings.items()}
        parts.append(f"## {network}\n\n{_standard(standards.get(network))}{_account(cells)}\n")
    return "\n".join(parts)


def _standard(quality: float | None) -> str:
    return "" if quality is None else f"On the standard clips: aligned PSNR {quality:.2f} dB. "


def _account(cells: Mapping[str, Cell]) -> str:
    ran = {title: cell for title, cell in cells.items() if isinstance(cell, Finding)}
    absent = {title: cell for title, cell in cells.items() if isinstance(cell, str)}
    failed = {title: cell for title, cell in ran.items() if cell.failed}
    lines = [f"Breaks in {len(failed)} of {len(ran)} probes that ran."] if ran else []
    lines += [f"- {title}: {_sentence(cell)}" for title, cell in failed.items()]
    held = [f"{title} ({_amount(cell.value)} {cell.unit})" for title, cell in ran.items()
            if not cell.failed]  # fmt: skip
    if held:
        lines += ["", "Holds: " + "; ".join(held) + "."]
    reasons: dict[str, list[str]] = {}
    for title, reason in absent.items():
        reasons.setdefault(reason, []).append(title)
    lines += [f"\nNot run, because {why}: {'; '.join(t)}." for why, t in reasons.items()]
    return "\n".join(lines)


def _sentence(cell: Finding) -> str:
    side = "at least" if cell.high else "at most"
    text = f"{_amount(cell.value)} {cell.unit}, allowed is {side} {cell.limit:g}"
    where = cell.breaks_at
    return text if where is None else f"{text}; beyond it from {cell.varied} = {where} on"


def _amount(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
