"""Checks Prometheus' files and the queries of other files with promtool."""
import json
import shutil
import tempfile
from pathlib import Path

import yaml

from tools import complaints

# Each with the alerts next to it, as in production.
SCRAPES = ["prometheus.yml", "compose/prometheus.yml"]


def files(deploy):
    wrong = []
    with tempfile.TemporaryDirectory() as scratch:
        scratch = Path(scratch)
        shutil.copy(deploy / "prometheus-alerts.yml", scratch)
        for file in SCRAPES:
            # The key files are at other paths.
            (scratch / "prometheus.yml").write_text((deploy / file).read_text())
            wrong += complaints(["promtool", "check", "config", "--syntax-only", "prometheus.yml"], cwd=scratch, label=file)
        wrong += complaints(["promtool", "check", "rules", deploy / "prometheus-alerts.yml"])
        questions = [("the dashboard", question) for question in of_dashboard(deploy)] + [("workers.yaml", question) for question in of_scaling(deploy)]
        for at, (where, question) in enumerate(questions):
            rule = {"groups": [{"name": "one", "rules": [{"record": "question", "expr": question}]}]}
            (scratch / f"{at}.yml").write_text(yaml.safe_dump(rule))
            wrong += complaints(["promtool", "check", "rules", f"{at}.yml"], cwd=scratch, label=f"{where}: {question}")
    return wrong


def of_dashboard(deploy):
    """Returns the dashboard's queries with Grafana's variables replaced."""
    panels = json.loads((deploy / "grafana-dashboard.json").read_text())["panels"]
    asked = [target["expr"] for panel in panels for target in panel.get("targets", [])]
    return sorted({question.replace("$__rate_interval", "1m").replace("$instance", ".*") for question in asked})


def of_scaling(deploy):
    scaled = yaml.safe_load((deploy / "kubernetes" / "autoscaled" / "workers.yaml").read_text())
    return [trigger["metadata"]["query"] for trigger in scaled["spec"]["triggers"]]


def alerts(deploy):
    """Tests the alerts on synthetic series: tests/deploy/alerts.yml."""
    with tempfile.TemporaryDirectory() as scratch:
        shutil.copy(deploy / "prometheus-alerts.yml", scratch)
        shutil.copy(Path(__file__).with_name("alerts.yml"), scratch)
        return complaints(["promtool", "test", "rules", "alerts.yml"], cwd=scratch)
