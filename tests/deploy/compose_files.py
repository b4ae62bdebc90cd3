"""Checks the stack of compose.yaml with docker compose, and its proxy configuration with Caddy."""
import importlib.util
import json
import re
import tempfile
from pathlib import Path

from tools import complaints, output

# The program itself, because the package's wrapper hides its exit code.
DOCKER_COMPOSE = Path(importlib.util.find_spec("compose").origin).with_name("docker-compose")
STACKS = [["compose.yaml"], ["compose.yaml", "compose.gpu.yaml"]]
VARIABLE = re.compile(r"^#?([A-Z_]+)=", re.MULTILINE)


def docker_compose(deploy, stack, scratch, *command):
    """Returns the command line of docker compose for these files, with every variable of .env set."""
    filled = Path(scratch) / ".env"
    filled.write_text("".join(f"{name}=/0123456789abcdef\n" for name in VARIABLE.findall((deploy / "env.example").read_text())))
    files = [word for file in stack for word in ("-f", deploy / file)]
    return [DOCKER_COMPOSE, "--project-directory", deploy, "--env-file", filled, *files, *command]


def services(deploy, stack):
    """Returns the services of a stack with inherited settings resolved."""
    with tempfile.TemporaryDirectory() as scratch:
        return json.loads(output(docker_compose(deploy, stack, scratch, "config", "--format", "json")))["services"]


def files(deploy):
    wrong = []
    with tempfile.TemporaryDirectory() as scratch:
        for stack in STACKS:
            wrong += complaints(docker_compose(deploy, stack, scratch, "config", "--quiet"), label=" and ".join(stack))
    return wrong


def mounts_and_variables(deploy):
    """Checks that mounted files exist and that env.example has exactly the variables that the files use."""
    wrong = []
    text = "".join((deploy / file).read_text() for file in STACKS[-1])
    for source in re.findall(r"^ +- (\./\S+?):", text, re.MULTILINE):
        wrong += [] if (deploy / source).exists() else [f"{source} is mounted, and is not there"]
    asked = set(re.findall(r"\$\{([A-Z_]+)", text))
    told = set(VARIABLE.findall((deploy / "env.example").read_text()))
    wrong += [f"{name} is asked for, and does not stand in env.example" for name in sorted(asked - told)]
    return wrong + [f"{name} stands in env.example, and nobody asks for it" for name in sorted(told - asked)]


def proxy(deploy):
    return complaints(["caddy", "validate", "--adapter", "caddyfile", "--config", deploy / "compose" / "Caddyfile"])
