"""Checks Kubernetes objects against their schemas and against each other."""
import tempfile
from pathlib import Path

import yaml
from cloudcoil.models.keda.v1alpha1 import ScaledObject
from cloudcoil.models.prometheus_operator.v1 import PodMonitor
from pydantic import ValidationError

from tools import ENVIRONMENT, complaints, output

KUSTOMIZATIONS = ["base", "autoscaled"]
EXAMPLES = ["base/secret.example.yaml", "base/ingress.example.yaml"]
# The oldest Kubernetes with all used features (the sleep action before a stop), and the newest known one.
VERSIONS = ["1.30", "1.37"]
# Custom resources, which do not belong to Kubernetes itself.
OTHERS = {"ScaledObject": ScaledObject, "PodMonitor": PodMonitor}
# The longest shutdown of the program: five seconds for requests, and the time to put jobs back.
STOPPING_S = 25


def built(deploy, name):
    return yaml.safe_load_all(output([ENVIRONMENT / "kubectl", "kustomize", deploy / "kubernetes" / name]))


def schemas(deploy):
    wrong = []
    with tempfile.TemporaryDirectory() as scratch:
        for name in KUSTOMIZATIONS:
            made = Path(scratch) / f"{name}.yaml"
            told = complaints([ENVIRONMENT / "kubectl", "kustomize", deploy / "kubernetes" / name, "--output", made], label=f"kustomize {name}")
            if told:
                wrong += told
                continue
            wrong += against_schemas(made)
        for example in EXAMPLES:
            wrong += against_schemas(deploy / "kubernetes" / example)
    return wrong


def against_schemas(file):
    wrong, ours = [], []
    for found in yaml.safe_load_all(file.read_text()):
        if found["kind"] in OTHERS:
            wrong += of_others(found)
        else:
            ours.append(found)
    with tempfile.TemporaryDirectory() as scratch:
        rest = Path(scratch) / file.name
        rest.write_text(yaml.safe_dump_all(ours))
        for version in VERSIONS:
            command = [ENVIRONMENT / "kubernetes-validate", "--strict", "--quiet", "--kubernetes-version", version, rest]
            wrong += complaints(command, label=f"{file.name}, Kubernetes {version}")
    return wrong


def of_others(found):
    """Checks custom resources with models generated from their schemas. The models drop unknown fields, so the output must equal the input."""
    who = f"{found['kind']} {found['metadata']['name']}"
    try:
        read = OTHERS[found["kind"]].model_validate(found).model_dump(by_alias=True, exclude_unset=True, mode="json")
    except ValidationError as error:
        return [f"{who}: {line}" for line in str(error).splitlines()]
    return [] if read == found else [f"{who} has fields that are not known"]


def containers(found):
    return found["spec"]["template"]["spec"]["containers"] if found["kind"] == "Deployment" else []


def references(deploy):
    """Checks names and labels that refer to other objects."""
    there = list(built(deploy, "autoscaled")) + [found for example in EXAMPLES for found in yaml.safe_load_all((deploy / "kubernetes" / example).read_text())]
    names = {(found["kind"], found["metadata"]["name"]) for found in there}
    pods = [found["spec"]["template"] for found in there if found["kind"] == "Deployment"]
    wrong = []

    def wants(who, kind, name):
        if (kind, name) not in names:
            wrong.append(f"{who} names the {kind} {name}, which is not there")

    def chooses(who, labels):
        if not any(labels.items() <= pod["metadata"]["labels"].items() for pod in pods):
            wrong.append(f"{who} chooses {labels}, as no pod is labelled")

    for found in there:
        who, spec = f"{found['kind']} {found['metadata']['name']}", found.get("spec", {})
        match found["kind"]:
            case "Deployment":
                labels = spec["template"]["metadata"]["labels"]
                if not spec["selector"]["matchLabels"].items() <= labels.items():
                    wrong.append(f"{who} does not choose its own pods")
                for source in (source for container in containers(found) for source in container["envFrom"]):
                    for kind, key in (("ConfigMap", "configMapRef"), ("Secret", "secretRef")):
                        if key in source:
                            wants(who, kind, source[key]["name"])
            case "Service":
                chooses(who, spec["selector"])
                ports = {port["name"] for pod in pods for container in pod["spec"]["containers"] for port in container["ports"]}
                wrong += [f"{who} leads to a port {port['targetPort']}" for port in spec["ports"] if port["targetPort"] not in ports]
            case "PodDisruptionBudget" | "PodMonitor":
                chooses(who, spec["selector"]["matchLabels"])
            case "NetworkPolicy":
                chooses(who, spec["podSelector"]["matchLabels"])
            case "HorizontalPodAutoscaler" | "ScaledObject":
                wants(who, spec["scaleTargetRef"].get("kind", "Deployment"), spec["scaleTargetRef"]["name"])
            case "Ingress":
                for path in (path for rule in spec["rules"] for path in rule["http"]["paths"]):
                    wants(who, "Service", path["backend"]["service"]["name"])
    return wrong


def restrictions(deploy):
    """Checks the requirements of the Pod Security Standard `restricted`, and the time to stop."""
    wrong = []
    for found in built(deploy, "base"):
        if found["kind"] != "Deployment":
            continue
        who, pod = found["metadata"]["name"], found["spec"]["template"]["spec"]
        wanted = {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}}
        wrong += [f"{who}: {name} is not {value}" for name, value in wanted.items() if pod["securityContext"].get(name) != value]
        if pod["automountServiceAccountToken"] is not False:
            wrong.append(f"{who}: its pods may talk to Kubernetes")
        for container in pod["containers"]:
            wanted = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}}
            wrong += [f"{who}: {name} is not {value}" for name, value in wanted.items() if container["securityContext"].get(name) != value]
            wrong += [f"{who}: no limit of {what}" for what in ("memory", "ephemeral-storage") if what not in container["resources"]["limits"]]
            pause = container.get("lifecycle", {}).get("preStop", {}).get("sleep", {}).get("seconds", 0)
            if pod["terminationGracePeriodSeconds"] < pause + STOPPING_S:
                wrong.append(f"{who}: {pod['terminationGracePeriodSeconds']} s to stop in, of which {pause} pass first")
    return wrong
