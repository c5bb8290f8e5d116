// A product of matrices, C = A B, or with ADD C += A B; any of them may be part of a larger one, or transposed. A workgroup
// computes a tile of C and goes through the inner dimension in steps whose parts of A and B it shares.
// A_INNER, B_INNER: the elements of A's rows, of B's columns lie beside one another in memory; else those of A's columns, of
// B's rows. The inner dimension may be split; each part then has a C of its own, which matmul_sum adds up in their order.
#import common/index

struct Matmul {
    rows: u32,           // of C
    columns: u32,
    inner: u32,
    split: u32,          // inner elements of a part
    a_stride: u32,       // from one row of A to the next, or, without A_INNER, from one column to the next
    b_stride: u32,       // from one column of B to the next, or, without B_INNER, from one row to the next
    c_stride: u32,       // from one row of C to the next
    c_part: u32,         // from one part's C to the next
    first: vec4<u32>,    // elements before A, B and C
}

const TILE = 64u;        // rows and columns of C
const DEPTH = 16u;       // inner elements of a step; a lane loads TILE x DEPTH / LANES = 4 of A and 4 of B
const LANES = 256u;
const PITCH = TILE + 4u; // so that the elements that are stored together lie in different banks

#ifdef A_INNER
const A_INNER = true;
#else
const A_INNER = false;
#endif
#ifdef B_INNER
const B_INNER = true;
#else
const B_INNER = false;
#endif

@group(0) @binding(0) var<uniform> product: Matmul;
@group(0) @binding(1) var<storage, read> a: array<f32>;
@group(0) @binding(2) var<storage, read> b: array<f32>;
@group(0) @binding(3) var<storage, read_write> c: array<f32>;

var<workgroup> of_a: array<f32, DEPTH * PITCH>;   // by inner element, then by row
var<workgroup> of_b: array<f32, DEPTH * PITCH>;

// Place of the k-th element that a lane loads in a tile: along the tile's side (x) and along the inner dimension (y). Lanes
// beside one another load what lies beside one another in memory.
fn place_in_tile(lane: u32, k: u32, inner_first: bool) -> vec2<u32> {
    let along_inner = vec2(lane / DEPTH + k * (LANES / DEPTH), lane % DEPTH);
    let along_side = vec2(lane % TILE, lane / TILE + k * (LANES / TILE));
    return select(along_side, along_inner, inner_first);
}

// Index of an element of A or B, whose steps along the side and along the inner dimension are 1 and `stride`, or the reverse.
fn index_of(side: u32, inner: u32, stride: u32, inner_first: bool) -> u32 {
    return select(inner * stride + side, side * stride + inner, inner_first);
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let across = (product.columns + TILE - 1u) / TILE;
    let down = (product.rows + TILE - 1u) / TILE;
    let number = workgroup_number(group, groups);
    let part = number / (across * down);
    let tile = vec2(number / across % down, number % across) * TILE;
    let begin = part * product.split;
    if (begin >= product.inner) {
        return;
    }
    let end = min(begin + product.split, product.inner);
    let mine = vec2(lane / 16u, lane % 16u) * 4u;
#unroll i 4
    var sum$i = vec4(0.0);
#end
    for (var at = begin; at < end; at += DEPTH) {
#unroll k 4
        {
            let of_row = place_in_tile(lane, $(k)u, A_INNER);
            let row = tile.x + of_row.x;
            let inner = at + of_row.y;
            var value = 0.0;
            if (row < product.rows && inner < end) {
                value = a[product.first.x + index_of(row, inner, product.a_stride, A_INNER)];
            }
            of_a[of_row.y * PITCH + of_row.x] = value;
        }
        {
            let of_column = place_in_tile(lane, $(k)u, B_INNER);
            let column = tile.y + of_column.x;
            let inner = at + of_column.y;
            var value = 0.0;
            if (column < product.columns && inner < end) {
                value = b[product.first.y + index_of(column, inner, product.b_stride, B_INNER)];
            }
            of_b[of_column.y * PITCH + of_column.x] = value;
        }
#end
        workgroupBarrier();
#unroll k 16
        {
            let row = $(k)u * PITCH + mine.x;
            let column = $(k)u * PITCH + mine.y;
            let of_columns = vec4(of_b[column], of_b[column + 1u], of_b[column + 2u], of_b[column + 3u]);
#unroll i 4
            sum$i = fma(vec4(of_a[row + $(i)u]), of_columns, sum$i);
#end
        }
#end
        workgroupBarrier();
    }
    let first = product.first.z + part * product.c_part;
#unroll i 4
    if (tile.x + mine.x + $(i)u < product.rows) {
#unroll j 4
        if (tile.y + mine.y + $(j)u < product.columns) {
#ifdef ADD
            c[first + (tile.x + mine.x + $(i)u) * product.c_stride + tile.y + mine.y + $(j)u] += sum$i[$j];
#else
            c[first + (tile.x + mine.x + $(i)u) * product.c_stride + tile.y + mine.y + $(j)u] = sum$i[$j];
#endif
        }
#end
    }
#end
}
