// The timing of a capture, on the page: motion/timing.py.

// Whether it is of times that ascend and of as many moments that do not descend, all in [0, 1].
export function isTiming(timing) {
    const rises = (list, least) => Array.isArray(list) && list.every((x, i) => typeof x === "number" && x >= 0 && x <= 1
        && !(x - list[i - 1] < least));
    return rises(timing?.times, Number.MIN_VALUE) && rises(timing.moments, 0) && timing.times.length > 0
        && timing.times.length === timing.moments.length;
}

// The moment of the motion at a time in [0, 1]; of no timing (null) the time itself.
export function momentAt(timing, t) {
    if (!timing) return t;
    const { times, moments } = timing;
    const after = times.findIndex(time => time > t), before = after < 0 ? times.length - 1 : Math.max(0, after - 1);
    const late = i => moments[i] - times[i];
    const share = after > 0 ? (t - times[before]) / (times[after] - times[before]) : 0;
    const shift = share ? late(before) + share * (late(after) - late(before)) : late(before);
    return Math.min(Math.max(t + shift, 0), 1);
}
