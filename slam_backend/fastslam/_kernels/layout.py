"""Layout of the workspace and of packed records, and constants that kernels share."""

import math

import numpy as np

from slam_backend.fastslam._kernels.records import ROBOT, SLOT, WEIGHT

# Lanes of a block: whole vectors of four numbers. At most 4 % are padding for 50, 100, 200 or 1000 particles.
LANES = 52
REJECTED = -1  # in place of a slot or id
# In place of a matched candidate: the measurement is rejected, or starts a landmark.
NO_MATCH, NEW_LANDMARK = -1.0, -2.0
MIN_DEPTH = 0.05  # [m]; smallest depth at which a landmark is predicted
MAX_DISTANCE = float(np.finfo(np.float64).max)  # largest finite squared distance
FAR = np.float32(1e18)  # entry of the descriptors of free slots, far from any other
LOG_2PI = math.log(2.0 * math.pi)

# Rows of the workspace.
X, Y, T, COS, SIN = (LANES * k for k in range(5))  # linearisation point of the pose
X0, Y0, T0 = (LANES * k for k in range(5, 8))  # predicted pose
C00, C10, C11, C20, C21, C22 = (LANES * k for k in range(8, 14))  # factor C of its covariance; C01 is below
XI0, XI1, XI2 = (LANES * k for k in range(14, 17))
COV_XI00, COV_XI01, COV_XI02, COV_XI11, COV_XI12, COV_XI22 = (LANES * k for k in range(17, 23))  # covariance of xi
INNOV0, INNOV1, INNOV2 = (LANES * k for k in range(23, 26))  # innovation
N00, N01, N02, N11, N12, N22, DEPTH = (LANES * k for k in range(26, 33))  # sensor noise in map axes, predicted depth
INFO00, INFO01, INFO02, INFO11, INFO12, INFO22, GRAD0, GRAD1, GRAD2 = (
    LANES * k for k in range(33, 42)
)  # sums over matches
SUM_D, MATCHED, DET, DET_EXP, DEPTHS, DEPTHS_EXP = (LANES * k for k in range(42, 48))  # factors of the likelihood
CLUTTER = LANES * 48  # log-likelihood of the measurements that are not matched
# Of one measurement: least and second least cost, matched candidate, whether a landmark in the dead zone forbids a new
# one, and log-likelihood of the best candidate.
BEST_COST, SECOND_COST, CHOSEN, DEAD_ZONE, LOG_BEST = (LANES * k for k in range(49, 54))
LOST, SURE, CONTRADICT, IS_WIDE = (LANES * k for k in range(54, 58))
TAKEN, C01 = LANES * 58, LANES * 59
KEPT00, KEPT10, KEPT11, KEPT20, KEPT21, KEPT22, KEPT01, KEPT_WIDE = (LANES * k for k in range(60, 68))  # of C
DRAW0, DRAW1, DRAW2 = (LANES * k for k in range(68, 71))  # standard normal
BIAS0, BIAS1, BIAS2 = (LANES * k for k in range(71, 74))  # odometry bias
PREDICTED0, PREDICTED1, PREDICTED2 = (
    LANES * k for k in range(74, 77)
)  # predicted pose, while X0 .. T0 hold the posterior mean
# Of one measurement once the choice is made: least D of any candidate now and in the evaluation before, and whether the
# lane holds any.
LEAST_D, LEAST_FIRST_D, ANY_HELD = (LANES * k for k in range(77, 80))
WORK_SIZE, COV_XI_SIZE = LANES * 80, LANES * 6

# Rows of the record of one candidate.
Q_INFO00, Q_INFO01, Q_INFO02, Q_INFO11, Q_INFO12, Q_INFO22, Q_GRAD0, Q_GRAD1, Q_GRAD2 = (LANES * k for k in range(9))
Q_SQUARE, Q_DET, Q_DET_POSE, Q_DEPTH, Q_METRES2, Q_D, Q_FIRST_D, Q_HELD = (LANES * k for k in range(9, 17))
CANDIDATE_ROWS = 17

POSES, STARTS, MEANS, BIASES, COVARIANCES = ROBOT
LOG_WEIGHTS, PATH_LOG_WEIGHTS, WEIGHTS, LOG_LIKELIHOOD = WEIGHT
ROW_OF, MAP_OF, IDS, IDENTITIES, LAST_SEEN, FREE_SLOTS = SLOT
MOTION_KIND, BEGIN, END, COVARIANCES_GIVEN, HAS_IDS, COUNT = range(6)  # columns of `StepInput.inputs_table`
NO_READING, STATIONARY, MOVED, EXACT_POSE = range(
    4
)  # kinds of motion: no input, frame without odometry, odometry, pose
# Entry of the run log for one robot and step: whether the robot had input, its kind of motion, whether its measurements
# have covariances, number of used measurements, odometry or exact pose (3), and estimated pose (3).
LOGGED, LOGGED_KIND, HAS_COVARIANCES, USED, MOTION, ESTIMATE, NUM_NOTED = 0, 1, 2, 3, 4, 7, 10
NAME, NUM_MEASURED = 9, 10  # columns of a logged measurement: associated landmark, behind point and covariance
ASSOCIATED, CREATED = range(2)  # rows of the data association (2, n)
TILE = 9 * LANES  # particle m is lane m % LANES of block m // LANES
BLOCK = np.uint32(LANES)  # as divisor: unsigned division takes half the instructions
