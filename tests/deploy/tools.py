"""Programs that check, and what they say."""
import subprocess
import sys
from pathlib import Path

# Programs of Python packages stand beside the interpreter of their environment.
ENVIRONMENT = Path(sys.executable).parent


def complaints(command, cwd=None, label=None, environment=None):
    """What a program says that gives up; nothing where it does not."""
    done = subprocess.run([str(word) for word in command], cwd=cwd, capture_output=True, text=True, env=environment)
    if done.returncode == 0:
        return []
    lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
    return [f"{label or Path(command[0]).name}: {line.strip()[:300]}" for line in lines[-6:] or [f"exit code {done.returncode}"]]


def output(command, cwd=None):
    """What a program says; it must not give up."""
    return subprocess.run([str(word) for word in command], cwd=cwd, capture_output=True, text=True, check=True).stdout
