// Loops of prioritized replay. A caller has checked types, devices and lengths.
//
// A tree over N slots has its leaves in blocks. The smallest power of two of `blocks` that hold them are
// the leaves of an array of 2 * blocks nodes, where node k has the children 2k and 2k + 1; the leaves of
// the slots come after them. Levels within a block are not kept, but made from its leaves, which lie
// side by side. Numbers of a tree are `stride` apart, as several trees may share an array. Sums and
// minima are made in the order of TorchRL's trees, so that they are the same to the last bit.
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
  char *stored;
  char *rows;
  int64_t bytes;   // Of one row.
  int64_t number;  // 4 or 8: single or double precision; else 0.
} Column;

enum {
  BLOCK = 16,  // Also in trees.py.
  AHEAD = 8,  // Rows whose memory is asked for before they are needed.
  SIDE = 16   // Descents side by side, each of which waits for memory at every level.
};

static inline double least(double a, double b) { return a < b ? a : b; }

static int64_t outside(const int64_t *slots, int64_t n, int64_t end) {
  int64_t wrong = 0;
  for (int64_t i = 0; i < n; i++) wrong |= slots[i] < 0 || slots[i] >= end;
  return wrong;
}

// Trees.

// The sum or minimum of n leaves, a power of two of them up to a block.
static inline double fold(const double *leaf, int64_t stride, int64_t n, int64_t minimum) {
  double v[BLOCK];
  for (int64_t i = 0; i < n; i++) v[i] = leaf[i * stride];
  for (; n > 1; n >>= 1)
    for (int64_t i = 0; i < n / 2; i++)
      v[i] = minimum ? least(v[2 * i], v[2 * i + 1]) : v[2 * i] + v[2 * i + 1];
  return v[0];
}

// Returns 1, and writes nothing, if a slot is not below `size`.
int64_t set_leaves(double *t, int64_t stride, int64_t blocks, int64_t minimum, int64_t size,
                   const int64_t *slots, const double *leaf, int64_t n) {
  if (outside(slots, n, size)) return 1;
  double *leaves = t + 2 * blocks * stride;
  for (int64_t i = 0; i < n; i++) leaves[slots[i] * stride] = leaf[i];
  for (int64_t i = 0; i < n; i++) {
    int64_t b = slots[i] / BLOCK;
    t[(blocks + b) * stride] = fold(leaves + b * BLOCK * stride, stride, BLOCK, minimum);
  }
  // Level by level, so that no slot waits for another; of a narrow level all nodes.
  for (int shift = 1; blocks >> shift; shift++) {
    int64_t nodes = blocks >> shift, all = nodes < n;
    for (int64_t i = 0; i < (all ? nodes : n); i++) {
      int64_t k = all ? nodes + i : (blocks | slots[i] / BLOCK) >> shift;
      double a = t[2 * k * stride], b = t[(2 * k + 1) * stride];
      t[k * stride] = minimum ? least(a, b) : a + b;
    }
  }
  return 0;
}

// The sum or minimum at a node, with nodes of the levels within blocks counted on.
static double at(const double *t, int64_t stride, int64_t blocks, int64_t minimum, int64_t k) {
  if (k < 2 * blocks) return t[k * stride];
  int64_t n = 1;
  for (; k < BLOCK * blocks; k <<= 1) n <<= 1;
  return fold(t + (k + 2 * blocks - BLOCK * blocks) * stride, stride, n, minimum);
}

double query(const double *t, int64_t stride, int64_t blocks, int64_t minimum, int64_t size,
             int64_t start, int64_t end) {
  if (start <= 0 && end >= size) return t[stride];
  double result = minimum ? 1.7976931348623157e308 : 0.0;
  for (int64_t l = BLOCK * blocks + start, r = BLOCK * blocks + end; l < r; l >>= 1, r >>= 1)
    for (int side = 0; side < 2; side++)
      if ((side ? r : l) & 1) {
        double v = at(t, stride, blocks, minimum, side ? --r : l++);
        result = minimum ? least(result, v) : result + v;
      }
  return result;
}

// Slots at shares of the sum of the filled slots.
void find(const double *t, int64_t stride, int64_t blocks, int64_t size, int64_t filled,
          const double *share, int64_t n, int64_t *slots) {
  double total = query(t, stride, blocks, 0, size, 0, filled);
  for (int64_t i = 0; i < n; i += SIDE) {
    int m = n - i < SIDE ? (int)(n - i) : SIDE;
    int64_t k[SIDE];
    double v[SIDE];
    for (int j = 0; j < m; j++) { k[j] = 1; v[j] = share[i + j] * total; }
    for (int64_t d = 1; d < blocks; d <<= 1)
      for (int j = 0; j < m; j++) {
        int64_t q = k[j] << 1;
        double left = t[q * stride];
        int right = v[j] > left;
        v[j] -= left * right;  // No branch, as it could not be predicted.
        k[j] = q | right;
      }
    // Rounding can carry the last bit of mass past the last slot, and the last block.
    for (int j = 0; j < m; j++) {
      k[j] = (k[j] ^ blocks) * BLOCK;
      for (int64_t l = 0; k[j] < size && l < BLOCK * stride; l += 8)
        __builtin_prefetch(t + (2 * blocks + k[j]) * stride + l);
    }
    for (int j = 0; j < m; j++) {
      for (int64_t half = BLOCK / 2, end = size - 1; half && k[j] <= end; half >>= 1) {
        double left = fold(t + (2 * blocks + k[j]) * stride, stride, half, 0);
        int right = v[j] > left;
        v[j] -= left * right;
        k[j] += right * half;
      }
      slots[i + j] = k[j] < filled ? k[j] : filled - 1;
    }
  }
}

// Rows of transitions.

// Both return 1, and do nothing, if a slot is not below `end`.
int64_t gather(const Column *columns, int64_t count, const int64_t *slots, int64_t n, int64_t end) {
  if (outside(slots, n, end)) return 1;
  for (int64_t c = 0; c < count; c++) {
    int64_t b = columns[c].bytes;
    if (b == 0) continue;
    const char *from = columns[c].stored;
    char *to = columns[c].rows;
    // A copy whose size the compiler knows takes one instruction.
    if (b == 1) for (int64_t i = 0; i < n; i++) to[i] = from[slots[i]];
    else if (b == 4) for (int64_t i = 0; i < n; i++) memcpy(to + 4 * i, from + 4 * slots[i], 4);
    else if (b == 8) for (int64_t i = 0; i < n; i++) memcpy(to + 8 * i, from + 8 * slots[i], 8);
    else
      for (int64_t i = 0; i < n; i++) {
        __builtin_prefetch(from + slots[i + AHEAD < n ? i + AHEAD : i] * b);
        memcpy(to + i * b, from + slots[i] * b, b);
      }
  }
  return 0;
}

int64_t scatter(const Column *columns, int64_t count, const int64_t *slots, int64_t n, int64_t end) {
  if (outside(slots, n, end)) return 1;
  for (int64_t c = 0; c < count; c++) {
    int64_t b = columns[c].bytes;
    for (int64_t i = 0; b && i < n; i++) memcpy(columns[c].stored + slots[i] * b, columns[c].rows + i * b, b);
  }
  return 0;
}

// Signals and priorities.

typedef struct {
  double sum, lowest;       // Of the leaves.
  double highest;           // Minus the highest priority that was learned.
  double priority;          // Of a slot; of no use in other nodes.
} Node;                     // Two are one line of a cache.

typedef struct {
  Node *nodes;
  double *table;                  // Rows of signals, [N, columns].
  int64_t slots, blocks, columns;  // N; of the tree; of the table.
} Replay;

// The last three columns are the reward, the replay count and the time of writing.
static inline double *row_of(const Replay *r, int64_t slot) { return r->table + slot * r->columns; }
static inline Node *leaf_of(const Replay *r, int64_t slot) { return r->nodes + 2 * r->blocks + slot; }
static inline void ask_for(const Replay *r, const int64_t *slots, int64_t i, int64_t n) {
  __builtin_prefetch(row_of(r, slots[i + AHEAD < n ? i + AHEAD : i]));
}

static void lift(Node *t, int64_t blocks, const int64_t *slots, int64_t n) {
  for (int64_t i = 0; i < n; i++) {
    int64_t b = slots[i] / BLOCK;
    const Node *leaves = t + 2 * blocks + b * BLOCK;
    t[blocks + b].sum = fold(&leaves->sum, 4, BLOCK, 0);
    t[blocks + b].lowest = fold(&leaves->lowest, 4, BLOCK, 1);
    t[blocks + b].highest = fold(&leaves->highest, 4, BLOCK, 1);
  }
  for (int shift = 1; blocks >> shift; shift++) {
    int64_t nodes = blocks >> shift, all = nodes < n;
    for (int64_t i = 0; i < (all ? nodes : n); i++) {
      int64_t k = all ? nodes + i : (blocks | slots[i] / BLOCK) >> shift;
      Node a = t[2 * k], b = t[2 * k + 1];
      t[k].sum = a.sum + b.sum;
      t[k].lowest = least(a.lowest, b.lowest);
      t[k].highest = least(a.highest, b.highest);
    }
  }
}

// Set leaves and priorities of slots, in all three trees. Returns 1, and writes nothing, if a slot is not
// below `size`.
int64_t put(Node *t, int64_t blocks, int64_t size, const int64_t *slots, const double *leaf,
            const double *priority, int64_t learned, int64_t n) {
  if (outside(slots, n, size)) return 1;
  for (int64_t i = 0; i < n; i++)
    t[2 * blocks + slots[i]] = (Node){leaf[i], leaf[i], learned ? -priority[i] : INFINITY, priority[i]};
  lift(t, blocks, slots, n);
  return 0;
}

// Sample by Eq. (8) out of the filled slots, with weights of Eq. (10) and times of writing, and count
// a replay of each. Returns 1, and does nothing, if a priority is not positive.
int64_t sample(const Replay *r, int64_t filled, const double *share, int64_t n, double beta,
               int64_t *slots, float *weight, double *written) {
  Node *t = r->nodes;
  double low = query(&t->lowest, 4, r->blocks, 1, r->slots, 0, filled);
  if (!(low > 0.0 && t[1].sum > 0.0)) return 1;
  find(&t->sum, 4, r->blocks, r->slots, filled, share, n, slots);
  for (int64_t i = 0; i < n; i++) {
    ask_for(r, slots, i, n);
    double *end = row_of(r, slots[i]) + r->columns;
    end[-2] += 1.0;
    written[i] = end[-1];
    weight[i] = (float)pow(leaf_of(r, slots[i])->sum / low, -beta);
  }
  return 0;
}

typedef struct {
  const double *weights;  // Of the signals that are fused, [fused]; learned ones are the first.
  int64_t fused, learned;
  double eps, alpha, level;
  int64_t bound;        // Of Eq. (22): 0 no boost, 1 floor, 2 cap, 3 none.
  double boost, margin; // How far above the mean of a batch a priority decays.
  const double *decay;  // Factors of Eq. (23) by place in a batch, or NULL.
  double highest;       // Results: the highest priority of the batches, and its slot.
  int64_t slot;
} Fusion;

// Returns 1 if a slot is not filled or was written since.
int64_t stale(const Replay *r, int64_t filled, const int64_t *slots, int64_t n, const double *written) {
  if (outside(slots, n, filled)) return 1;
  for (int64_t i = 0; written && i < n; i++) {
    ask_for(r, slots, i, n);
    if (row_of(r, slots[i])[r->columns - 1] != written[i]) return 1;
  }
  return 0;
}

// Set signals and priorities of live batches of one size by Eqs. (21)-(24), by way of copies of the
// rows. Returns 1, and changes nothing, if a number is wrong.
int64_t update(const Replay *r, Fusion *f, const int64_t *slots, int64_t n, int64_t batches,
               const float *const *signals) {
  int64_t columns = r->columns, size = n / batches, top = 0, wrong = 1;
  double *rows = malloc(8 * n * (columns + 1)), *priority = rows + n * columns;
  if (rows == NULL) return 1;
  for (int64_t i = 0; i < n; i++) {
    double *row = rows + i * columns, *end = row + columns, p = 0.0;
    memcpy(row, row_of(r, slots[i]), 8 * columns);
    for (int64_t k = 0; k < f->learned; k++) row[k] = (double)signals[k][i];
    for (int64_t k = 0; k < f->fused; k++) {
      if (!(row[k] >= 0.0 && row[k] < INFINITY)) goto end;
      p += row[k] * f->weights[k];
    }
    p += f->eps;
    if (f->bound && end[-3] > f->level) {
      p *= f->boost;
      if (f->bound == 1 && p < 1.0) p = 1.0;
      if (f->bound == 2 && p > 1.0) p = 1.0;
    }
    priority[i] = p;
  }
  for (int64_t u = 0; f->decay && u < batches; u++) {
    double *p = priority + u * size, mean = 0.0;
    for (int64_t i = 0; i < size; i++) mean += p[i];
    mean = mean / size * f->margin;
    for (int64_t i = 0; i < size; i++)
      if (p[i] > mean && rows[(u * size + i) * columns + columns - 3] > f->level) p[i] *= f->decay[i];
  }
  for (int64_t i = 1; i < n; i++)
    if (priority[i] > priority[top]) top = i;
  // A sum of so many leaves must not overflow.
  if (!(pow(priority[top], f->alpha) * r->slots < 1e307)) goto end;
  for (int64_t i = 0; i < n; i++) {
    double leaf = pow(priority[i], f->alpha);
    memcpy(row_of(r, slots[i]), rows + i * columns, 8 * columns);
    *leaf_of(r, slots[i]) = (Node){leaf, leaf, -priority[i], priority[i]};
  }
  lift(r->nodes, r->blocks, slots, n);
  // Of a slot that is named twice the last entry counts.
  for (int64_t i = top = 0; i < n; i++)
    if (leaf_of(r, slots[i])->priority > leaf_of(r, slots[top])->priority) top = i;
  f->highest = leaf_of(r, slots[top])->priority;
  f->slot = slots[top];
  wrong = 0;
end:
  free(rows);
  return wrong;
}

static int is_finite(const Column *c, int64_t n) {
  // A sum of products with zero is zero only if all numbers are finite.
  int64_t count = c->number ? n * c->bytes / c->number : 0;
  double sum = 0.0;
  if (c->number == 4) for (int64_t i = 0; i < count; i++) sum += 0.0 * ((const float *)c->rows)[i];
  if (c->number == 8) for (int64_t i = 0; i < count; i++) sum += 0.0 * ((const double *)c->rows)[i];
  return sum == 0.0;
}

// Write new transitions from a slot on, around the end, all with one priority. `reward` is the column
// that has the reward, `index` the one of slots, `signal` the place of its absolute value in the table,
// or -1. Returns 1, and writes nothing, if a number is not finite.
int64_t write_new(const Replay *r, const Column *columns, int64_t count, int64_t start, int64_t n,
                  const Column *reward, int64_t *index, int64_t signal, double time, double priority,
                  double alpha) {
  for (int64_t c = 0; c < count; c++)
    if (!is_finite(columns + c, n)) return 1;
  int64_t *slots = malloc(8 * n);
  if (slots == NULL) return 1;
  for (int64_t i = 0; i < n; i++) slots[i] = (start + i) % r->slots;
  scatter(columns, count, slots, n, r->slots);
  double leaf = pow(priority, alpha);
  for (int64_t i = 0; i < n; i++) {
    double *row = row_of(r, slots[i]), *end = row + r->columns;
    double value = reward->number == 4 ? ((const float *)reward->rows)[i] : ((const double *)reward->rows)[i];
    for (int64_t k = 0; k < r->columns - 3; k++) row[k] = NAN;
    if (signal >= 0) row[signal] = fabs(value);
    end[-3] = value;
    end[-2] = 0.0;
    end[-1] = time + i;
    index[slots[i]] = slots[i];
    *leaf_of(r, slots[i]) = (Node){leaf, leaf, INFINITY, priority};
  }
  lift(r->nodes, r->blocks, slots, n);
  free(slots);
  return 0;
}
