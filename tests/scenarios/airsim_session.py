"""Scripts written for AirSim, run by the Python of its unmodified client: ``PORT SCRIPT``.

The last line that it prints is what the script found, as JSON, which `test_airsim` judges. ``join`` of the
client hides errors, so that futures are asked for their results.
"""

import json
import sys

import airsim
import msgpackrpc
import numpy as np


def connected(port):
    client = airsim.MultirotorClient(port=port)
    client.confirmConnection()
    return client


def ready(port):
    client = connected(port)
    client.enableApiControl(True)
    assert client.armDisarm(True)
    return client


def at(client):
    return client.simGetVehiclePose().position.to_numpy_array().tolist()


def square(port):
    client = ready(port)
    flown = [client.takeoffAsync().get()]
    corners = []
    for x, y in ((20, 0), (20, 20), (0, 20), (0, 0)):
        flown.append(client.moveToPositionAsync(x, y, -6, 8).get())
        corners.append(at(client))
    flown.append(client.rotateToYawAsync(90).get())
    yaw = airsim.to_eularian_angles(client.simGetVehiclePose().orientation)[2]
    path = [airsim.Vector3r(5, 0, -8), airsim.Vector3r(5, 5, -8)]
    flown.append(client.moveOnPathAsync(path, 6).get())
    flown.append(client.moveByVelocityAsync(0, -3, 1, 1).get())
    flown.append(client.moveToZAsync(-4, 3).get())
    flown.append(client.hoverAsync().get())
    before = at(client)
    flown.append(client.goHomeAsync().get())
    flown.append(client.landAsync().get())
    landed = client.getMultirotorState().landed_state == airsim.LandedState.Landed
    return {
        "flown": flown,
        "corners": corners,
        "yaw": yaw,
        "before": before,
        "home": at(client),
        "landed": landed,
    }


def sensors(port):
    client = ready(port)
    client.moveToPositionAsync(0, 0, -2, 8).get()
    client.rotateToYawAsync(90).get()  # along the street
    client.simPause(True)
    kinds = airsim.ImageType
    answers = client.simGetImages(
        [
            airsim.ImageRequest("0", kinds.Scene, False, False),
            airsim.ImageRequest("front_center", kinds.DepthPlanar, True),
            airsim.ImageRequest("uav/front", kinds.DepthPerspective, True),
            airsim.ImageRequest("front", kinds.DepthVis, True),
            airsim.ImageRequest(0, kinds.Segmentation, False, True),
        ]
    )
    scan = client.getLidarData("LidarSensor1")
    picture = np.frombuffer(answers[0].image_data_uint8, np.uint8)
    planar, perspective, shown = (airsim.get_pfm_array(answer) for answer in answers[1:4])
    hit = planar < 60000
    found = {
        "size": [answers[0].height, answers[0].width, int(picture.size)],
        "colours": len(np.unique(picture)),
        "planar": [float(planar[hit].min()), float(planar[hit].max())],
        "rays": float((perspective[hit] - planar[hit]).min()),
        "shown": float(np.abs(shown[hit] - np.minimum(planar[hit] / 100, 1)).max()),
        "png": [
            answers[4].image_data_uint8[:4] == b"\x89PNG",
            client.simGetImage("0", kinds.Scene)[:4] == b"\x89PNG",
        ],
        "stamps": [answer.time_stamp for answer in answers] + [scan.time_stamp],
        "now": client.getMultirotorState().timestamp,
        "points": len(scan.point_cloud) // 3,
        "lowest": float(np.reshape(scan.point_cloud, (-1, 3))[:, 2].max()),
        "segments": len(scan.segmentation),
    }
    client.simPause(False)
    return found


def steps(port):
    client = ready(port)
    client.simPause(True)
    times = [client.simIsPause(), client.getMultirotorState().timestamp]
    client.simContinueForFrames(5)
    times.append(client.getMultirotorState().timestamp)
    motion = client.moveByVelocityAsync(2, 0, 0, 0.5)
    client.simContinueForTime(0.5)
    times.append(client.getMultirotorState().timestamp)
    done = motion.get()
    client.simPause(False)
    return {"times": times, "done": done, "paused": client.simIsPause()}


def errors(port):
    client = connected(port)
    client.reset()
    found = []
    for call in (
        lambda: client.simSetTimeOfDay(True),
        lambda: client.takeoffAsync().get(),
        lambda: client.simGetImages([airsim.ImageRequest("9", 0)]),
    ):
        try:
            call()
            found.append("")
        except msgpackrpc.error.RPCError as error:
            found.append(str(error))
    nowhere = client.simGetObjectPose("tree").position.x_val
    return {
        "errors": found,
        "nowhere": str(nowhere),
        "objects": client.simListSceneObjects("ua.*"),
        "wall": client.simSetObjectPose("wall", airsim.Pose()),
    }


def warm(port):
    return calls(port, 100)


def calls(port, rounds=500):
    """Two clients at once, with two calls each in a round."""
    first, second = ready(port), connected(port)
    first.simPause(True)
    motion = first.moveToPositionAsync(15, 0, -6, 1)
    seen = []
    for number in range(rounds):
        seen.append(first.getMultirotorState().timestamp)
        second.simGetVehiclePose()
        first.simGetCollisionInfo()
        seen.append(second.getMultirotorState().timestamp)
        if number % 50 == 0:
            assert second.getLidarData().point_cloud
            assert first.simGetImage("0", 0)
            second.simContinueForFrames(1)
    first.cancelLastTask()
    under_control = [first.isApiControlEnabled(), second.isApiControlEnabled()]
    first.simPause(False)
    return {
        "sorted": seen == sorted(seen),
        "frames": len(set(seen)),
        "done": motion.get(),
        "control": under_control,
    }


def hold(port):
    connected(port).simPause(True)
    return {}


if __name__ == "__main__":
    answer = globals()[sys.argv[2]](int(sys.argv[1]))
    sys.stdout.write("\n" + json.dumps(answer) + "\n")
