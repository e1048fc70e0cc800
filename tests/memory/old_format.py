"""A memory as format version 4 kept it: all entries in memory.json, all arrays in memory.safetensors."""

import hashlib
import json
from dataclasses import asdict

import numpy as np
from safetensors.numpy import save

from lerobot_openspm.geometry.camera import cameras_to_dict
from lerobot_openspm.memory.store import robot_to_dict
from lerobot_openspm.perception.objects.store import to_parts


def save_version_4(memory, directory):
    arrays, objects = {}, []
    for model in memory.objects.values():
        fields, own = to_parts(model)
        objects.append(fields)
        arrays |= {f"objects.{model.name}.{key}": np.ascontiguousarray(value) for key, value in own.items()}
    arrays["entries.T_obj_ee"] = np.stack([p.T_obj_ee for e in memory.entries for p in e.key_poses])
    arrays["entries.T_world_obj"] = np.stack([T for e in memory.entries for T in e.layout.values()])
    blob = save(arrays)
    directory.mkdir(exist_ok=True)
    (directory / "memory.safetensors").write_bytes(blob)
    (directory / "cameras.json").write_text(json.dumps(cameras_to_dict(memory.cameras)))
    memory = {
        "format": "openspm-memory",
        "version": 4,
        "arrays": {"file": "memory.safetensors", "sha256": hashlib.sha256(blob).hexdigest()},
        "perception": memory.perception,
        "segmentation": memory.segmentation,
        "shape": memory.shape,
        "simulator_objects": list(memory.simulator_objects),
        "robot": robot_to_dict(memory.robot),
        "objects": objects,
        "entries": [_row(entry) for entry in memory.entries],
    }
    (directory / "memory.json").write_text(json.dumps(memory))


def _row(entry):
    key_poses = []
    for pose in entry.key_poses:
        fields = asdict(pose)
        for newer in ("T_obj_ee", "sub_task", "covariance"):
            del fields[newer]
        if pose.axis is not None:
            fields["axis"]["direction"] = pose.axis.direction.tolist()
        key_poses.append(fields)
    sub_tasks = [
        {name: getattr(sub_task, name) for name in ("operation", "target", "part", "relation", "landmark")}
        for sub_task in entry.key.sub_tasks
    ]
    return {
        "language": entry.language,
        "key": {"sub_tasks": sub_tasks, "phases": list(entry.key.phases)},
        "quality": entry.quality,
        "version": entry.version,
        "source": entry.source,
        "key_poses": key_poses,
        "layout": list(entry.layout),
    }
