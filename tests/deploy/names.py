"""Checks that the program knows the commands, flags and variables that deploy/ uses."""
import re
import subprocess

import yaml

import compose_files
import kubernetes_files

PROGRAM = None
VARIABLE = re.compile(r"\bUNIGROUND_[A-Z_]+\b")
# Variables of env.example that only compose.yaml uses and passes on.
TEXTS = {".yaml", ".yml", ".service", ".example", ".py"}


def known(deploy):
    wrong, helps = [], {}
    for where, command in commands(deploy):
        # As written, followed by --help: help is printed before anything runs, but after all preceding arguments were parsed.
        done = subprocess.run([PROGRAM, *command, "--help"], capture_output=True, text=True)
        if done.returncode:
            wrong.append(f"{where}: uniground {' '.join(command)}: {done.stderr.strip().splitlines()[0]}")
        else:
            helps[command[0]] = done.stdout
    told = set(VARIABLE.findall("".join(helps.values())))
    for file in sorted(path for path in deploy.rglob("*") if path.suffix in TEXTS):
        for name in sorted(set(VARIABLE.findall(file.read_text())) - told):
            wrong.append(f"{file.relative_to(deploy)}: {name} is no variable of uniground {' or '.join(sorted(helps))}")
    return wrong


def commands(deploy):
    """Returns the places where the program is started, with their arguments."""
    for name, service in compose_files.services(deploy, compose_files.STACKS[-1]).items():
        if service.get("image", "").startswith("uniground"):
            yield f"compose.yaml, {name}", service["command"]
    for file in sorted((deploy / "kubernetes").rglob("*.yaml")):
        for found in yaml.safe_load_all(file.read_text()):
            for container in kubernetes_files.containers(found):
                yield f"{file.relative_to(deploy)}, {found['metadata']['name']}", container["args"]
    for line in (deploy / "uniground.service").read_text().splitlines():
        if line.startswith("ExecStart="):
            yield "uniground.service", line.split()[1:]
