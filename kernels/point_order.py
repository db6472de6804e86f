"""Puts points in the order of a balanced k-d tree (Bentley 1975): every half is split again across its longest side.

Eight neighbours in that order, and eight times eight of them, fill compact boxes that hardly overlap. A segment is
`size` places of the order, a power of two; all but the last one are full. Large segments may be split by sorting all
points at once, which suits a device with many threads, small ones each by a thread of its own.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

RUN = wp.constant(256)  # records of which one thread finds the bounds
KEY_BITS = wp.constant(30)  # of a sort key: segment, then place across it


@wp.kernel
def fill_records(offset: int, points: wp.array[wp.vec3], source: wp.array[int], records: wp.array[wp.vec4]):
    """One thread writes one point and, as bits, its number in `points`."""
    i = offset + wp.tid()
    p = points[source[i]]
    records[i] = wp.vec4(p[0], p[1], p[2], wp.cast(source[i], float))


@wp.kernel
def read_order(offset: int, records: wp.array[wp.vec4], order: wp.array[int]):
    """One thread copies one point's number."""
    i = offset + wp.tid()
    order[i] = wp.cast(records[i][3], int)


# Hoare's selection (1961) along the longest side of the bounds: nothing before `middle` lies beyond what is after.
SPLIT_AT = """
    struct Record { float at[4]; };
    Record* a = (Record*)records.data;
    float low[4], high[4];
    for (int k = 0; k < 4; ++k)
        low[k] = high[k] = a[begin].at[k];
    for (int i = begin + 1; i < end; ++i) {
        for (int k = 0; k < 4; ++k) {
            low[k] = a[i].at[k] < low[k] ? a[i].at[k] : low[k];
            high[k] = a[i].at[k] > high[k] ? a[i].at[k] : high[k];
        }
    }
    int axis = high[1] - low[1] > high[0] - low[0] ? 1 : 0;
    axis = high[2] - low[2] > high[axis] - low[axis] ? 2 : axis;
    int first = begin, last = end - 1;
    while (first < last) {
        const float u = a[first].at[axis], v = a[(first + last) / 2].at[axis], w = a[last].at[axis];
        const float pivot = u < v ? (v < w ? v : (u < w ? w : u)) : (u < w ? u : (v < w ? w : v));
        // what is below the pivot comes first (Lomuto, without a branch, as none could be foretold)
        int from = first;
        for (int i = first; i <= last; ++i) {
            const Record record = a[i];
            a[i] = a[from];
            a[from] = record;
            from += record.at[axis] < pivot;
        }
        if (middle < from) {
            last = from - 1;
        } else if (first < from) {
            first = from;
        } else {
            // nothing is: then what equals it
            for (int i = first; i <= last; ++i) {
                const Record record = a[i];
                a[i] = a[from];
                a[from] = record;
                from += record.at[axis] <= pivot;
            }
            if (middle < from)
                break;
            first = from;
        }
    }
"""


@wp.func_native(SPLIT_AT)
def split_at(records: wp.array[wp.vec4], begin: int, middle: int, end: int): ...


@wp.kernel
def split_segments(offset: int, count: int, size: int, smallest: int, records: wp.array[wp.vec4]):
    """One thread owns one segment and halves it until its parts are of the smallest size."""
    begin = (offset + wp.tid()) * size
    end = wp.min(begin + size, count)
    part = size
    while part > smallest:
        half = part // 2
        first = begin
        while first + half < end:
            split_at(records, first, first + half, wp.min(first + part, end))
            first += part
        part = half


@wp.kernel
def bound_runs(offset: int, records: wp.array[wp.vec4], low: wp.array[wp.vec3], high: wp.array[wp.vec3]):
    """One thread writes the bounds of one run of records."""
    i = offset + wp.tid()
    least = wp.vec3(records[i * RUN][0], records[i * RUN][1], records[i * RUN][2])
    most = least
    for k in range(i * RUN + 1, wp.min((i + 1) * RUN, records.shape[0])):
        p = wp.vec3(records[k][0], records[k][1], records[k][2])
        least = wp.min(least, p)
        most = wp.max(most, p)
    low[i] = least
    high[i] = most


@wp.kernel
def bound_segments(offset: int, low: wp.array[wp.vec3], high: wp.array[wp.vec3], runs: int, sides: wp.array[wp.vec3]):
    """One thread writes the longest side of one segment of `runs` runs: its axis, where it begins, and its length."""
    i = offset + wp.tid()
    least = low[i * runs]
    most = high[i * runs]
    for k in range(i * runs + 1, wp.min((i + 1) * runs, low.shape[0])):
        least = wp.min(least, low[k])
        most = wp.max(most, high[k])
    e = most - least
    axis = wp.where(e[1] > e[0], 1, 0)
    axis = wp.where(e[2] > e[axis], 2, axis)
    sides[i] = wp.vec3(float(axis), least[axis], e[axis])


@wp.kernel
def segment_keys(
    offset: int,
    records: wp.array[wp.vec4],
    sides: wp.array[wp.vec3],
    size: int,
    steps: int,
    keys: wp.array[int],
    values: wp.array[int],
):
    """One thread writes the sort key of one record: its segment, then in `steps` steps how far along its side."""
    i = offset + wp.tid()
    side = sides[i // size]
    along = (records[i][int(side[0])] - side[1]) / wp.max(side[2], 1.0e-37)
    keys[i] = (i // size) * steps + wp.min(int(along * float(steps)), steps - 1)
    values[i] = i


@wp.kernel
def move_records(offset: int, records: wp.array[wp.vec4], values: wp.array[int], moved: wp.array[wp.vec4]):
    """One thread puts one record in its new place."""
    i = offset + wp.tid()
    moved[i] = records[values[i]]
