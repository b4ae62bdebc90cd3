"""Runs checking programs and returns their output."""
import subprocess
import sys
from pathlib import Path

# Programs of Python packages are next to the interpreter of their environment.
ENVIRONMENT = Path(sys.executable).parent


def complaints(command, cwd=None, label=None, environment=None):
    """Returns the output of a program that fails; nothing if it succeeds."""
    done = subprocess.run([str(word) for word in command], cwd=cwd, capture_output=True, text=True, env=environment)
    if done.returncode == 0:
        return []
    lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
    return [f"{label or Path(command[0]).name}: {line.strip()[:300]}" for line in lines[-6:] or [f"exit code {done.returncode}"]]


def output(command, cwd=None):
    """Returns the output of a program that must succeed."""
    return subprocess.run([str(word) for word in command], cwd=cwd, capture_output=True, text=True, check=True).stdout
