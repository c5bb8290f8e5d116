// How the cells of a slice are shared among lanes.
// LONG_LANES, for devices of few wide cores: a lane takes several cells, so that a level's description is loaded once for all.

const LANES = 64u;
#ifdef LONG_LANES
const LANE_CELLS = 16u;
#else
const LANE_CELLS = 1u;
#endif
