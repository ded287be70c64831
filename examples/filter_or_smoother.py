# %% [markdown]
# # Filter or smoother?
#
# A session keeps the measurements of all frames in a log. Any estimator can replay it, so that
# filters and smoothers are compared on exactly the same measurements.

# %%
import fgslam as fg

recording = fg.rendered_recording("lab", frames=16)
with fg.Slam(recording.rig, estimator="landmark_kalman") as slam:
    for t, images, odometry in recording:
        slam.track(t, images, odometry)
log = slam.log  # or fg.MeasurementLog.load("drive.npz")

# %% [markdown]
# ## One log, four estimators
#
# One Kalman filter a landmark (Se et al. 2001), the full EKF, incremental and batch smoothing.

# %%
kinds = ("landmark_kalman", "ekf", "isam2", "batch")
answers = {kind: fg.replay(log, kind) for kind in kinds}

# %% [markdown]
# ## The table
#
# `ate_m`: absolute trajectory error after alignment. `nees`: normalised estimation error squared a
# degree of freedom, 1 where the covariance is right, more where the estimator is overconfident.

# %%
truth = recording.ground_truth
table = fg.compare(answers, truth)
print(table.round(4))

# %% [markdown]
# ## The figure

# %%
figure = fg.plot(answers, truth)
figure.write_html("filter_or_smoother.html")  # in a notebook: figure.show()
