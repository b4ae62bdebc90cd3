"""What is generated is what is committed."""

import subprocess
import sys

from served import ROOT


def test_models_and_client_are_up_to_date() -> None:
    check = subprocess.run([sys.executable, ROOT / "scripts/python-client.py", "--check"], capture_output=True, text=True)
    assert check.returncode == 0, check.stderr
