"""Deviations of ten million samples against allantools, over the same averaging times in one process.

    python -m benchmarks.allan_speed

writes benchmarks/results/allan_speed.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks._measure import in_fresh_process, table, timed, write_result

PEERS = {"allan": "oadev", "modified": "mdev", "hadamard": "ohdev", "total": "totdev"}
MUST = 5.0


def _lengths(rows: int, many: int) -> np.ndarray:
    if not many:
        return 2 ** np.arange(int(np.log2(rows / 4)) + 1)
    return np.unique(np.geomspace(1, rows // 4, many).round().astype(int))


def _measure(estimator: str, rows: int, many: int) -> dict[str, Any]:
    """Best of three calls of each, in turns; the first call of ours compiles before."""
    from gyromodel.noise import deviation

    rate = np.random.default_rng(1).standard_normal(rows)
    lengths = _lengths(rows, many)
    deviation(rate, 1.0, estimator, lengths[:1])
    ours, theirs, apart = [], [], 0.0
    for _ in range(3):
        own, spent = timed(lambda: deviation(rate, 1.0, estimator, lengths))
        ours.append(spent["wall"])
        if find_spec("allantools"):
            import allantools

            peer = getattr(allantools, PEERS[estimator])
            other, spent = timed(lambda peer=peer: peer(rate, rate=1.0, data_type="freq", taus=lengths.astype(float)))
            theirs.append(spent["wall"])
            apart = float(np.max(np.abs(own.deviation[: len(other[1])] / other[1] - 1.0)))
    return {"lengths": len(lengths), "ours": min(ours), "theirs": min(theirs, default=0.0), "apart": apart}


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Deviations against allantools.")
    parser.add_argument("--rows", type=int, default=10_000_000)
    parser.add_argument("--only", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.only:
        print(json.dumps(_measure(args.only[0], args.rows, int(args.only[1]))))
        return
    rows = []
    for many in (0, 100):
        for estimator in PEERS:
            command = ("--rows", str(args.rows), "--only", estimator, str(many))
            m = in_fresh_process("benchmarks.allan_speed", *command)
            peer = ["–", "–", "–"]
            if m["theirs"]:
                ratio = m["theirs"] / m["ours"]
                peer = [f"{m['theirs']:.2f}", f"{ratio:.1f}", f"{m['apart']:.0e}"]
            lengths = f"{m['lengths']} {'log-spaced' if many else 'octaves'}"
            rows.append([estimator, lengths, f"{m['ours']:.2f}", *peer])
    head = ["deviation", "averaging lengths", "gyromodel s", "allantools s", "ratio", "largest relative difference"]
    found = "" if find_spec("allantools") else " allantools is not installed: there is nothing to compare with."
    lines = [
        f"{args.rows:,} samples of white noise, no gaps; best of three calls in turns, one process each row. The aim "
        f"is {MUST:g} times the speed.{found}",
        "",
        *table(head, rows),
    ]
    write_result("allan_speed", "Speed of deviations", "allan_speed", argv, lines)


if __name__ == "__main__":
    main()
