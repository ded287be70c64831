# %% [markdown]
# # A live robot
#
# A camera delivers at its own pace; the estimator takes the newest frame and leaves out those that
# it had no time for. Here a recording is played at its own speed in another process: a folder or
# bag that is named on the command line, or, without a name, the rendered laboratory. Ctrl-C saves
# the map.
#
#     python live_robot.py my_bag.mcap

# %%
import contextlib
import signal
import sys
import threading
import time
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np

import fgslam as fg
from fgslam.runs.library import RecordedFrames

SPEED = 4.0 if len(sys.argv) < 2 else 1.0  # the laboratory was driven slowly


def recording() -> RecordedFrames:
    """What the camera plays."""
    if len(sys.argv) > 1:
        return fg.open_recording(sys.argv[1])
    return fg.rendered_recording("lab", frames=12)


# %% [markdown]
# ## The camera
#
# Another process, as a driver would be. It sends each frame when its time has come and asks nobody
# whether that is convenient.


# %%
def camera(wire: Connection) -> None:
    """Sends frames at their time."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the robot
    frames = recording()
    start, first = time.monotonic(), frames.timestamps[0]
    for t, images, odometry in frames:
        time.sleep(max(0.0, start + (t - first) / SPEED - time.monotonic()))
        wire.send((t, images, odometry))
    wire.send(None)


# %% [markdown]
# ## The robot
#
# A thread receives; `NewestFrame` keeps the newest frame, with the odometry of those before it that
# were left out. `track` runs in the main thread, where Ctrl-C arrives.


# %%
def receive(wire: Connection, frames: fg.NewestFrame) -> None:
    """Puts what is sent, until the camera ends, or its process does."""
    with contextlib.suppress(EOFError, OSError):
        while (sent := wire.recv()) is not None:
            frames.put(*sent)
    frames.close()


def main() -> None:
    """Tracks until the camera ends or Ctrl-C is pressed; then saves the map."""
    here, there = get_context("spawn").Pipe(duplex=False)
    get_context("spawn").Process(target=camera, args=(there,), daemon=True).start()
    source, frames, in_time = recording(), fg.NewestFrame(), 0
    frame_ms = 1e3 * float(np.median(np.diff(source.timestamps))) / SPEED
    threading.Thread(target=receive, args=(here, frames), daemon=True).start()
    slam = fg.Slam(source.rig, estimator="landmark_kalman")
    try:
        for t, images, odometry in frames:
            began = time.perf_counter()
            step = slam.track(t, images, odometry)
            x, _, z = step.wTc[:3, 3]
            milliseconds = 1e3 * (time.perf_counter() - began)
            in_time += milliseconds <= frame_ms
            print(
                f"{t:5.2f} s  {step.status.value:5}  x {x:6.3f} z {z:6.3f} m  {milliseconds:.0f} ms"
            )
    except KeyboardInterrupt:
        print("stopped")
    if not len(slam.log):
        return  # before the first frame
    result = slam.result()
    result.map.save("live.fgmap")  # to begin in next time
    count, dropped = len(result.trajectory), frames.dropped
    print(f"{count} frames, {dropped} left out, {len(result.map)} landmarks")
    print(f"{100.0 * in_time / count:.0f} % of the poses within the frame time, {frame_ms:.0f} ms")
    print(f"{100.0 * dropped / (count + dropped):.0f} % of the frames that came were left out")


if __name__ == "__main__":
    main()
