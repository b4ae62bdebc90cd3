#!/usr/bin/env python3
"""Runs the commands of README.md and the manual as printed, page by page.

Every `sh` and `python` block of a page runs in order, in one shell, from the root of a clone with
`uniground` on PATH. A page starts and stops its own server. A block that cannot run unattended has
the line `<!-- not run: REASON -->` directly before it; reasons are printed.

usage: scripts/test-docs.py PROGRAM [PAGE…]
"""

import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
# The guide for Python, whose blocks share their names, is run by clients/python/tests/test_docs.py.
PAGES = ["README.md"] + sorted(
    str(page.relative_to(ROOT))
    for page in (ROOT / "docs").rglob("*.md")
    if page.name != "python.md"
)
FENCE = re.compile(
    r"(?:<!-- not run: (?P<reason>[^\n]*?) -->\n\s*)?"
    r"^(?P<indent> *)```(?P<language>sh|python)\n(?P<body>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)
SECONDS = 300


def script_of(page: str) -> tuple[str, int, list[str]]:
    """Returns the page's blocks as one script, their number, and the reasons of those left out."""
    lines, run, left_out = ["set -euo pipefail"], 0, []
    text = (ROOT / page).read_text()
    for block in FENCE.finditer(text):
        line = text[: block.start("body")].count("\n") + 1
        if block["reason"]:
            left_out.append(f"{page}:{line}: not run: {block['reason']}")
            continue
        body = re.sub(rf"^{block['indent']}", "", block["body"], flags=re.MULTILINE)
        if block["language"] == "python":
            body = f"python3 - <<'END_OF_PYTHON'\n{body}END_OF_PYTHON\n"
        lines += [f"echo '== {page}:{line}' >&2", body]
        run += 1
    return "\n".join(lines) + "\n", run, left_out


def run(page: str, script: str, program: pathlib.Path) -> bool:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:
        environment = {
            **os.environ,
            "HOME": home,
            "XDG_CACHE_HOME": f"{home}/cache",
            "UNIGROUND_DATA_DIR": f"{home}/data",
            # In seconds, with or without a folder of models.
            "UNIGROUND_MASKS": "builtin",
            "UNIGROUND_ENCODER": "builtin",
            "PATH": f"{program.parent}:{ROOT / '.venv-python/bin'}:{os.environ['PATH']}",
        }
        for name in ("UNIGROUND_REQUIRE_SHARED", "PROGRAM"):
            environment.pop(name, None)
        # A page's files must not end up in the checkout.
        clone = pathlib.Path(home, "clone")
        clone.mkdir()
        for entry in ROOT.iterdir():
            clone.joinpath(entry.name).symlink_to(entry)
        log = pathlib.Path(home, "log")
        with log.open("w") as output:
            shell = subprocess.Popen(
                ["bash", "-c", script], cwd=clone, env=environment, stdout=output,
                stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, start_new_session=True,
            )
            try:
                failed = shell.wait(SECONDS) != 0
            except subprocess.TimeoutExpired:
                failed = True
                output.write(f"not done after {SECONDS} s\n")
            # Servers that the page left running.
            for number in (signal.SIGTERM, signal.SIGKILL):
                try:
                    os.killpg(shell.pid, number)
                except ProcessLookupError:
                    break
                time.sleep(1)
        if failed:
            print(f"{page} FAILED. The end of its output:\n{log.read_text()[-3000:]}", flush=True)
        return not failed


def main() -> int:
    program = pathlib.Path(sys.argv[1]).resolve()
    failed = 0
    for page in sys.argv[2:] or PAGES:
        script, blocks, left_out = script_of(page)
        print("\n".join(left_out), end="\n" if left_out else "")
        if blocks:
            start = time.monotonic()
            held = run(page, script, program)
            failed += not held
            if held:
                print(f"{page}: {blocks} blocks, {time.monotonic() - start:.0f} s", flush=True)
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
