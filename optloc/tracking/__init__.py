"""Trackers: filters that predict and update the state of a target scan by scan, started by fixes of `optloc.solve`."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.tracking.associate import (
        Associate as Associate,
        Clutter as Clutter,
        assigned as assigned,
        joint as joint,
        nearest as nearest,
    )
    from optloc.tracking.constants import (
        begun_with_constants as begun_with_constants,
        followed_with_constants as followed_with_constants,
    )
    from optloc.tracking.dynamics import (
        Dynamics as Dynamics,
        correlated as correlated,
        current_statistical as current_statistical,
        polynomial as polynomial,
        singer as singer,
    )
    from optloc.tracking.entry import Entry as Entry, Rules as Rules, scan_sentence as scan_sentence
    from optloc.tracking.measurement_space import lines as lines, simplified as simplified
    from optloc.tracking.named_models import (
        MOTIONS as MOTIONS,
        MotionModel as MotionModel,
        motion_named as motion_named,
    )
    from optloc.tracking.run import Follower as Follower, collected as collected, tracked as tracked
    from optloc.tracking.several_models import imm as imm, parallel as parallel, resized as resized
    from optloc.tracking.several_targets import (
        Missing as Missing,
        RowCandidates as RowCandidates,
        alone as alone,
        associated as associated,
        candidates as candidates,
    )
    from optloc.tracking.start import (
        begun as begun,
        first_fix as first_fix,
        is_one_gaussian as is_one_gaussian,
        state_of as state_of,
        two_point as two_point,
        with_height_rows as with_height_rows,
    )
    from optloc.tracking.track import (
        State as State,
        Track as Track,
        followed as followed,
        predicted as predicted,
        scans as scans,
    )
    from optloc.tracking.updates import (
        UPDATES as UPDATES,
        Filter as Filter,
        Update as Update,
        Updated as Updated,
        ekf as ekf,
        filter_of as filter_of,
        gated as gated,
        iekf as iekf,
        innovation as innovation,
        joseph as joseph,
        mgekf as mgekf,
        mvekf as mvekf,
        reweighted as reweighted,
        whitened as whitened,
    )
    from optloc.tracking.whole_run import fitted as fitted, posterior_bound as posterior_bound, smoothed as smoothed

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
