"""The uniground program, packaged for Python."""

from __future__ import annotations

import os
import shutil
import sysconfig

__all__ = ["program"]


def program() -> str:
    """Returns the path of the `uniground` program that this package installed.

    Raises FileNotFoundError if it is missing.
    """
    name = "uniground" + (sysconfig.get_config_var("EXE") or "")
    schemes = [sysconfig.get_path("scripts")]
    if user := sysconfig.get_preferred_scheme("user"):
        schemes.append(sysconfig.get_path("scripts", scheme=user))
    for folder in schemes:
        path = os.path.join(folder, name)
        if os.path.isfile(path):
            return path
    if found := shutil.which(name):
        return found
    raise FileNotFoundError(f"{name} is not in {schemes[0]}: reinstall uniground-server")
