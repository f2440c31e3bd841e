"""The launch files in docker/: held against the published schemas, the guide, the image and each other.

No Kubernetes and no cloud was at hand. What a schema cannot say is not checked here.
"""

import copy
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from string import Template
from typing import Any

import jsonschema
import pytest
import ray
import yaml
from ray.autoscaler._private.util import prepare_config, validate_config

from es_service import api
from es_service.cli.common import overrides
from tests.system.processes import ROOT

DOCKER = ROOT / "docker"
KUBERAY = json.loads((Path(__file__).parent / "schemas" / "kuberay.json").read_text())
IN_IMAGE = "/opt/es-service/"
PARAMETERS = {
    "IMAGE": "registry.example.com/es-service:1",
    "NAME": "first",
    "CONFIG": f"{IN_IMAGE}configs/cluster/ant_maze_me_es.yaml",
    "REGION": "us-west-2",
    "AMI": "ami-0123456789abcdef0",
    "WHEELS": "/home/me/es-service/build/ray-up",
}
KINDS = {"kuberay-rayjob.yaml": "RayJob", "kuberay-raycluster.yaml": "RayCluster"}
NO_PRIVILEGES = {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
DRAIN = "RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S"


def load(name: str) -> dict[str, Any]:
    """A launch file with its parameters filled in, as envsubst does."""
    return yaml.safe_load(Template((DOCKER / name).read_text()).safe_substitute(PARAMETERS))


def errors(manifest: dict[str, Any], kind: str) -> list[str]:
    """What KubeRay's schema has against a manifest."""
    schema = KUBERAY[kind] | {"definitions": KUBERAY["definitions"]}
    return [error.message for error in jsonschema.Draft7Validator(schema).iter_errors(manifest)]


def cluster_of(manifest: dict[str, Any]) -> dict[str, Any]:
    """The cluster that a RayJob or a RayCluster describes."""
    return manifest["spec"].get("rayClusterSpec", manifest["spec"])


@pytest.mark.parametrize(("name", "kind"), KINDS.items())
def test_manifest_has_kuberays_schema(name, kind):
    assert errors(load(name), kind) == []


def changed(path: str, value: Any) -> Any:
    """A function that sets what is at a path of keys in a manifest; None renames the last key to another."""

    def change(manifest: dict[str, Any]) -> None:
        *parents, last = [int(key) if key.isdigit() else key for key in path.split("/")]
        node: Any = manifest
        for key in parents:
            node = node[key]
        if value is None:
            node[f"{last}s"] = node.pop(last)
        else:
            node[last] = value

    return change


HEAD_POD = "spec/rayClusterSpec/headGroupSpec/template/spec"
WORKER_POD = "spec/rayClusterSpec/workerGroupSpecs/0/template/spec"


@pytest.mark.parametrize(
    "mistake",
    [
        pytest.param(changed("apiVersion", "ray.io/v1alpha1"), id="another version"),
        pytest.param(changed("kind", "RayCluster"), id="another kind"),
        pytest.param(changed("spec/backoffLimit", None), id="misspelled field of the job"),
        pytest.param(changed("spec/rayClusterSpec/authOptions/secretName", None), id="misspelled secret"),
        pytest.param(changed("spec/rayClusterSpec/authOptions/mode", "password"), id="no such mode"),
        pytest.param(changed("spec/backoffLimit", "ten"), id="text for a number"),
        pytest.param(changed("spec/rayClusterSpec/headGroupSpec/rayStartParams/num-cpus", 0), id="number for a text"),
        pytest.param(changed(f"{HEAD_POD}/containers/0/volumeMounts/0/mountPath", None), id="misspelled mount"),
        pytest.param(changed(f"{WORKER_POD}/terminationGracePeriodSeconds", None), id="misspelled grace"),
        pytest.param(changed(f"{WORKER_POD}/containers/0/resources/requests/cpu", "8 cores"), id="no amount"),
    ],
)
def test_mistake_in_a_manifest_is_found(mistake):
    manifest = copy.deepcopy(load("kuberay-rayjob.yaml"))
    mistake(manifest)
    assert errors(manifest, "RayJob")


@pytest.mark.parametrize("name", KINDS)
def test_cluster_is_safe_and_hands_work_over(name):
    """Token; the driver alone on the head; a grace longer than the drain; runs on a disk that outlives the cluster."""
    cluster = cluster_of(load(name))
    assert cluster["authOptions"] == {"mode": "token", "secretName": "es-service-token"}
    (group,) = cluster["workerGroupSpecs"]
    head, worker = cluster["headGroupSpec"]["template"]["spec"], group["template"]["spec"]
    assert cluster["headGroupSpec"]["rayStartParams"] == {"num-cpus": "0"}
    (container,) = worker["containers"]
    drain = {entry["name"]: float(entry["value"]) for entry in container["env"]}[DRAIN]
    assert drain + 20 < worker["terminationGracePeriodSeconds"] == head["terminationGracePeriodSeconds"]
    (volume,) = head["volumes"]
    claim = yaml.safe_load((DOCKER / "kuberay-runs.yaml").read_text())
    assert volume["persistentVolumeClaim"] == {"claimName": claim["metadata"]["name"]}
    for pod in (head, worker):
        assert pod["securityContext"]["runAsUser"] == 1000, "the user of the image"
        (container,) = pod["containers"]
        assert container["image"] == PARAMETERS["IMAGE"]
        assert container["resources"]["requests"] == container["resources"]["limits"]
        assert container["securityContext"] == NO_PRIVILEGES
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert cluster["autoscalerOptions"]["securityContext"] == NO_PRIVILEGES


def test_only_rays_pods_and_the_operator_reach_rays_pods():
    """By the labels of KubeRay 1.7 and its chart, whose schemas have no NetworkPolicy."""
    policy = load("kuberay-network.yaml")
    assert (policy["apiVersion"], policy["kind"]) == ("networking.k8s.io/v1", "NetworkPolicy")
    of_ray = {"matchLabels": {"ray.io/is-ray-node": "yes"}}
    of_operator = {"matchLabels": {"app.kubernetes.io/name": "kuberay-operator"}}
    dashboard = {"protocol": "TCP", "port": 8265}
    assert policy["spec"] == {
        "podSelector": of_ray,
        "policyTypes": ["Ingress"],
        "ingress": [
            {"from": [{"podSelector": of_ray}]},
            {"from": [{"namespaceSelector": {}, "podSelector": of_operator}], "ports": [dashboard]},
        ],
    }


def test_containers_of_compose_are_limited_and_their_token_is_a_file():
    compose = yaml.safe_load((DOCKER / "compose.yaml").read_text())
    assert compose["secrets"] == {"token": {"environment": "TOKEN"}}
    checks = {name: service["healthcheck"]["test"] for name, service in compose["services"].items()}
    assert checks["head"] == ["CMD", "ray", "health-check"]
    assert "http://127.0.0.1:" in checks["worker"][3], "a worker answers for its own raylet, and not for the head"
    for service in compose["services"].values():
        assert service["environment"] == {"RAY_AUTH_TOKEN_PATH": "/run/secrets/token"}
        assert service["secrets"] == ["token"]
        assert service["restart"] == "unless-stopped"
        assert service["deploy"]["resources"]["limits"]["memory"]
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"], "as allowPrivilegeEscalation: false says it"


@pytest.mark.parametrize("extras", ["", "cluster,gymnasium"])
def test_image_has_the_extras_that_are_named(extras):
    """The program of the Dockerfile that lists what is installed, run here."""
    (program,) = re.findall(r"python -c '(.*?)' \"", (DOCKER / "Dockerfile").read_text(), flags=re.DOTALL)
    words = [sys.executable, "-c", program.replace("\\\n", ""), extras]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    assert any(line.startswith("jax") for line in listed)
    for extra, package in (("cluster", "ray[default]"), ("gymnasium", "gymnasium[mujoco]")):
        assert any(line.startswith(package) for line in listed) == (extra in extras)


def test_disk_of_the_runs_has_the_schema_of_a_claim():
    """That schema is in KubeRay's, as a pod's ephemeral volume has one."""
    claim = yaml.safe_load((DOCKER / "kuberay-runs.yaml").read_text())
    assert (claim["apiVersion"], claim["kind"]) == ("v1", "PersistentVolumeClaim")
    text = json.dumps(KUBERAY)
    (schema,) = {json.dumps(found) for found in _schemas_with(KUBERAY, {"accessModes", "volumeMode", "resources"})}
    assert schema in text
    validator = jsonschema.Draft7Validator(json.loads(schema) | {"definitions": KUBERAY["definitions"]})
    validator.validate(claim["spec"])
    with pytest.raises(jsonschema.ValidationError, match="accessMode"):
        validator.validate({"accessMode": ["ReadWriteOnce"]})


def _schemas_with(node: Any, keys: set[str]) -> list[dict[str, Any]]:
    """Schemas of objects that have at least these keys."""
    if isinstance(node, list):
        return [found for entry in node for found in _schemas_with(entry, keys)]
    if not isinstance(node, dict):
        return []
    properties = node.get("properties")
    here = [node] if isinstance(properties, dict) and keys <= properties.keys() else []
    return here + [found for entry in node.values() for found in _schemas_with(entry, keys)]


def test_cluster_of_virtual_machines_has_rays_schema():
    config = load("ray-up.yaml")
    validate_config(prepare_config(copy.deepcopy(config)))
    for key, wrong in (("max_worker", 4), ("available_node_types", {"head": {"resources": {}}})):
        with pytest.raises(jsonschema.ValidationError):
            validate_config(prepare_config(copy.deepcopy(config) | {key: wrong}))


def test_cluster_of_virtual_machines_is_safe_and_hands_work_over():
    config = load("ray-up.yaml")
    head, worker = config["available_node_types"]["head"], config["available_node_types"]["worker"]
    assert head["resources"] == {"CPU": 0}
    assert (worker["min_workers"], worker["max_workers"]) == (0, config["max_workers"])
    assert "/home/ubuntu/.ray/auth_token" in config["file_mounts"]
    for commands in (config["head_start_ray_commands"], config["worker_start_ray_commands"]):
        start = commands[-1]
        assert "--setenv=RAY_AUTH_MODE=token" in start
        assert "--block" in start, "only then SIGTERM drains the node"
        grace = float(re.findall(r"TimeoutStopSec=(\d+)", start)[0])
        assert float(re.findall(rf"{DRAIN}=(\d+)", start + f" {DRAIN}=30")[0]) + 20 < grace
    assert "--dashboard-host=127.0.0.1" in config["head_start_ray_commands"][-1]


def entry_points() -> dict[str, tuple[str, int]]:
    """File -> the command that starts a run there, and the cores of all workers that may be started."""
    job = load("kuberay-rayjob.yaml")
    found = {"kuberay-rayjob.yaml": (job["spec"]["entrypoint"], cores(job))}
    for name in ("kuberay-raycluster.yaml", "ray-up.yaml"):
        text = re.sub(r"^# ?", "", (DOCKER / name).read_text(), flags=re.MULTILINE).replace("\\\n", " ")
        (command,) = re.findall(r"es-service submit .*", text)
        config = load(name)
        found[name] = command, cores(config) if "kind" in config else config["max_workers"] * 8
    return found


def cores(manifest: dict[str, Any]) -> int:
    """Cores of the worker pods that a manifest allows."""
    (group,) = cluster_of(manifest)["workerGroupSpecs"]
    (container,) = group["template"]["spec"]["containers"]
    return group["maxReplicas"] * int(container["resources"]["limits"]["cpu"])


@pytest.mark.parametrize("name", [*KINDS, "ray-up.yaml"])
def test_run_asks_the_autoscaler_for_every_worker(name):
    """Its command is one that the command line takes; without a number of workers, it would ask for one at a time."""
    command, most = entry_points()[name]
    words = shlex.split(command)
    options = {word: words[at + 1] for at, word in enumerate(words) if word in ("--workers", "--out", "--address")}
    settings = [words[at + 1] for at, word in enumerate(words) if word == "--set"]
    assert options["--out"].startswith(("/runs/", "/home/ubuntu/runs/"))
    assert int(options["--workers"]) == most
    assert words[:2] == ["es-service", "submit"] or (words[:2] == ["es-service", "run"] and "--or-resume" in words)
    path = ROOT / words[2].removeprefix(IN_IMAGE)
    loaded = api.load_config(path, overrides(settings, workers=most, address="auto"))
    assert loaded.compute.worker_resources.cpu == 8
    assert loaded.compute.no_worker_timeout_s >= 600, "a machine takes minutes to come up"


def test_versions_are_those_of_the_image():
    [pinned] = re.findall(r"^ray==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert {cluster_of(load(name))["rayVersion"] for name in KINDS} == {pinned} == {ray.__version__}


@pytest.mark.parametrize("name", [*KINDS, "kuberay-runs.yaml", "kuberay-network.yaml", "ray-up.yaml", "slurm.sh"])
def test_guide_shows_every_launch_file(name):
    guide = (DOCKER / "README.md").read_text()
    assert f"]({name})" in guide
    assert f"docker/{name}" in guide
