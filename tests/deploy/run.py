#!/usr/bin/env python3
"""Checks the files of deploy/ with the tools that read them: each file as it is, and again with deliberate faults, which the tool must find.

usage: run.py --program target/release/uniground        (scripts/test-deploy.sh installs the tools)
"""
import argparse
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

sys.dont_write_bytecode = True

import compose_files
import kubernetes_files
import names
import prometheus_files
import triton_files

ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Check:
    """A check takes the folder deploy and returns its errors, one per line."""
    what: str
    check: callable
    # Deliberate faults: file, text, and its replacement.
    broken: list


CHECKS = [
    Check("compose files, as docker compose reads them", compose_files.files,
          [("compose.yaml", "  stop_grace_period: 30s", "  stop_grace_time: 30s"),
           ("compose.gpu.yaml", "capabilities: [gpu]", "capability: [gpu]")]),
    Check("what compose files mount, and ask of .env, is there", compose_files.mounts_and_variables,
          [("compose.yaml", "./compose/garage.toml", "./compose/garage.tml"), ("env.example", "GRAFANA_PASSWORD=", "GRAFANA_WORD=")]),
    Check("the proxy's file, as Caddy reads it", compose_files.proxy, [("compose/Caddyfile", "uri_hash", "hash_uri")]),
    Check("Kubernetes' objects against their schemas, as kustomize builds them", kubernetes_files.schemas,
          [("kubernetes/base/api.yaml", "periodSeconds: 5", "periodSecs: 5"),
           ("kubernetes/base/secret.example.yaml", "stringData:", "stringDatas:"),
           ("kubernetes/autoscaled/workers.yaml", "minReplicaCount", "minReplicas"),
           ("kubernetes/autoscaled/monitor.yaml", "podMetricsEndpoints", "podEndpoints"),
           ("kubernetes/autoscaled/kustomization.yaml", "../base", "../bass")]),
    Check("Kubernetes' objects name each other rightly", kubernetes_files.references,
          [("kubernetes/base/api.yaml", "labels: *labels\n    spec", "labels: {app.kubernetes.io/name: uniground}\n    spec"),
           ("kubernetes/base/api.yaml", "selector: {app.kubernetes.io/name: uniground, ", "selector: {app.kubernetes.io/name: unground, "),
           ("kubernetes/base/worker.yaml", "secretRef: {name: uniground}", "secretRef: {name: secrets}"),
           ("kubernetes/base/ingress.example.yaml", "service: {name: uniground-api,", "service: {name: uniground-apis,"),
           ("kubernetes/autoscaled/workers.yaml", "scaleTargetRef: {name: uniground-worker}", "scaleTargetRef: {name: uniground}")]),
    Check("Kubernetes' pods may nothing they do not need", kubernetes_files.restrictions,
          [("kubernetes/base/worker.yaml", "readOnlyRootFilesystem: true", "readOnlyRootFilesystem: false"),
           ("kubernetes/base/api.yaml", "terminationGracePeriodSeconds: 40", "terminationGracePeriodSeconds: 8")]),
    Check("Prometheus' files, and every question to it", prometheus_files.files,
          [("compose/prometheus.yml", "static_configs", "static_config"), ("prometheus.yml", "authorization", "authorisation"),
           ("prometheus-alerts.yml", "sum by (", "sum of ("),
           ("kubernetes/autoscaled/workers.yaml", "query: max(", "query: maximum("),
           ("grafana-dashboard.json", "histogram_quantile(", "histogram_quantile[")]),
    Check("alerts fire for several processes when they should", prometheus_files.alerts,
          [("prometheus-alerts.yml", "sum by (job, kind) (increase(uniground_jobs_finished_total[30m]))",
            "sum by (instance, kind) (increase(uniground_jobs_finished_total[30m]))")]),
    Check("every command, flag and variable is one the program knows", names.known,
          [("compose.yaml", "UNIGROUND_LINK_SECRET: $", "UNIGROUND_LINKS_SECRET: $"), ("compose.yaml", "[serve, --role, api]", "[serve, --rule, api]"),
           ("kubernetes/base/worker.yaml", "parse,naming,batch", "parse,name,batch"), ("uniground.service", "UNIGROUND_LOG_FORMAT", "UNIGROUND_LOG_FORM"),
           ("env.example", "#UNIGROUND_MASKS", "#UNIGROUND_MASK")]),
    Check("a model repository of bundles, as Triton reads it", triton_files.repository,
          [("triton/make_repository.py", 'f\'{word} [ {{', 'f\'{word}s [ {{'),
           ("triton/make_repository.py", "onnx.TensorProto.INT64: \"TYPE_INT64\"", "onnx.TensorProto.INT64: \"TYPE_INT32\"")]),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", required=True, type=Path)
    names.PROGRAM = parser.parse_args().program.resolve()
    failed = 0
    for one in CHECKS:
        wrong = one.check(ROOT / "deploy")
        blind = [breakage for breakage in one.broken if not found(one.check, wrong, *breakage)]
        print(f"{'passed' if not wrong and not blind else 'FAILED'}  {one.what}; {len(one.broken) - len(blind)} of {len(one.broken)} faults found", flush=True)
        for line in wrong:
            print(f"        {line}")
        for file, old, new in blind:
            print(f"        not found: {file}, {old!r} become {new!r}")
        failed += bool(wrong or blind)
    print(f"{len(CHECKS) - failed} passed, {failed} failed")
    sys.exit(failed > 0)


def found(check, known, file, old, new):
    """Returns whether a check finds an error that the unmodified folder does not have."""
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "deploy"
        shutil.copytree(ROOT / "deploy", copy)
        text = (copy / file).read_text()
        if old not in text:
            raise AssertionError(f"{file} has no {old!r} to break: tests/deploy/run.py needs another fault")
        (copy / file).write_text(text.replace(old, new, 1))
        return bool(set(check(copy)) - set(known))


if __name__ == "__main__":
    main()
