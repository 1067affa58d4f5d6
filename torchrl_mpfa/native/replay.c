// Loops of prioritized replay: trees and rows. A caller has checked types, devices and lengths.
#define _GNU_SOURCE  // RUSAGE_THREAD.
#include <math.h>
#include <stdint.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <unistd.h>
#ifndef RUSAGE_THREAD
#define RUSAGE_THREAD RUSAGE_SELF
#endif

enum {
  WIDE = 16,  // Children of a node, also in trees.py.
  AHEAD = 8,  // Memory that is asked for before it is needed.
  SIDE = 16   // Descents side by side, each of which waits for memory at every level.
};

static const double EMPTY = 1.7976931348623157e308;  // A minimum of nothing, as in TorchRL.

static inline double least(double a, double b) { return a < b ? a : b; }

static int64_t outside(const int64_t *slots, int64_t n, int64_t end) {
  int64_t wrong = 0;
  for (int64_t i = 0; i < n; i++) wrong |= slots[i] < 0 || slots[i] >= end;
  return wrong;
}

// Trees.
//
// Of every slot there is a leaf and a priority. Sixteen of them are the children of a node of the first
// level, sixteen nodes those of one of the next, up to one. A level has the sums of all its nodes, then the
// lowest leaves, then minus the highest priorities, each filled up to sixteen. The three levels of two
// children that lie between are not kept but made, so that sums are added in the order of TorchRL's trees
// of two children, and are the same to the last bit.
//
// A leaf of -0.0 cannot be sampled and is no lowest one. A priority that is negative was never learned, and
// is no highest one.

typedef struct {
  int64_t count, room;  // Nodes of a level, and with what fills it up.
  double *sum, *low, *high;
} Level;

static Level first_level(double *nodes, int64_t size) {
  Level up = {(size + WIDE - 1) / WIDE, 0, nodes, 0, 0};
  up.room = (up.count + WIDE - 1) / WIDE * WIDE;
  up.low = up.sum + up.room;
  up.high = up.low + up.room;
  return up;
}

static Level next_level(Level l) { return first_level(l.high + l.room, l.count); }

static inline double sum_of(const double *v) {
  double a[8];
  for (int i = 0; i < 8; i++) a[i] = v[2 * i] + v[2 * i + 1];
  for (int i = 0; i < 4; i++) a[i] = a[2 * i] + a[2 * i + 1];
  return (a[0] + a[1]) + (a[2] + a[3]);
}

static inline double least_of(const double *v) {
  double a[8];
  for (int i = 0; i < 8; i++) a[i] = least(v[i], v[i + 8]);
  for (int i = 0; i < 4; i++) a[i] = least(a[i], a[i + 4]);
  return least(least(a[0], a[1]), least(a[2], a[3]));
}

static inline double low_of(double leaf) { return signbit(leaf) ? EMPTY : leaf; }
static inline double high_of(double priority) { return priority >= 0.0 && !signbit(priority) ? -priority : EMPTY; }

// Set leaves of slots, and their priorities unless these are NULL. Returns 1, and writes nothing, if a slot is
// not below `size`.
int64_t put(double *leaf, double *priority, double *nodes, int64_t size, const int64_t *slots,
            const double *leaves, const double *priorities, int64_t n) {
  if (outside(slots, n, size)) return 1;
  for (int64_t i = 0; i < n; i++) {
    const double *ahead = leaf + slots[i + AHEAD < n ? i + AHEAD : i] / WIDE * WIDE;
    __builtin_prefetch(ahead, 1);
    __builtin_prefetch(ahead + 8, 1);
    leaf[slots[i]] = leaves[i];
    if (priorities) priority[slots[i]] = priorities[i];
  }
  Level l = first_level(nodes, size);
  for (int64_t i = 0, last = -1; i < n; i++) {
    int64_t k = slots[i] / WIDE;
    if (k == last) continue;
    last = k;
    double v[WIDE];
    l.sum[k] = sum_of(leaf + k * WIDE);
    for (int j = 0; j < WIDE; j++) v[j] = low_of(leaf[k * WIDE + j]);
    l.low[k] = least_of(v);
    if (!priorities) continue;
    for (int j = 0; j < WIDE; j++) v[j] = high_of(priority[k * WIDE + j]);
    l.high[k] = least_of(v);
  }
  // Level by level, so that no slot waits for another; of a narrow level all nodes.
  for (int shift = 8; l.count > 1; shift += 4) {
    Level up = next_level(l);
    int64_t all = up.count < n;
    for (int64_t i = 0, last = -1; i < (all ? up.count : n); i++) {
      int64_t k = all ? i : slots[i] >> shift;
      if (k == last) continue;
      last = k;
      up.sum[k] = sum_of(l.sum + k * WIDE);
      up.low[k] = least_of(l.low + k * WIDE);
      up.high[k] = least_of(l.high + k * WIDE);
    }
    l = up;
  }
  return 0;
}

// The sum of the first leaves, or the lowest of them, or minus the highest of their priorities: a kind of 0, 1
// or 2. Nodes of two children are counted as in a heap whose leaves come after `half` nodes.
double query(const double *leaf, const double *priority, double *nodes, int64_t kind, int64_t size,
             int64_t filled) {
  Level l = first_level(nodes, size);
  double result = kind ? EMPTY : 0.0;
  if (filled >= size) {
    while (l.count > 1) l = next_level(l);
    return kind == 0 ? *l.sum : kind == 1 ? *l.low : *l.high;
  }
  // A left part of a tree is a node of each height that has a bit in its length, taken from the lowest
  // height on: as TorchRL adds them.
  for (int64_t height = 0, end = filled; end; height++, end >>= 1) {
    if (height > 4 && height % 4 == 0) l = next_level(l);
    if (!(end & 1)) continue;
    int64_t nodes_below = (int64_t)1 << height % 4, first = (end - 1) * nodes_below;
    double v[8];
    for (int64_t j = 0; j < nodes_below; j++) {
      int64_t k = first + j;
      if (height < 4) v[j] = kind == 0 ? leaf[k] : kind == 1 ? low_of(leaf[k]) : high_of(priority[k]);
      else v[j] = kind == 0 ? l.sum[k] : kind == 1 ? l.low[k] : l.high[k];
    }
    for (int64_t n = nodes_below; n > 1; n >>= 1)
      for (int64_t j = 0; j < n / 2; j++) v[j] = kind ? least(v[2 * j], v[2 * j + 1]) : v[2 * j] + v[2 * j + 1];
    result = kind ? least(result, v[0]) : result + v[0];
  }
  return result;
}

// The child at a mass, of sixteen; the mass becomes that within the child.
static inline int64_t child_at(const double *v, double *mass) {
  double a8[8], a4[4], m = *mass;
  for (int i = 0; i < 8; i++) a8[i] = v[2 * i] + v[2 * i + 1];
  for (int i = 0; i < 4; i++) a4[i] = a8[2 * i] + a8[2 * i + 1];
  double left = a4[0] + a4[1];
  // No branches, as they could not be predicted.
  int64_t k = m > left, right = k;
  m -= left * right;
  right = m > a4[2 * k]; m -= a4[2 * k] * right; k = 2 * k + right;
  right = m > a8[2 * k]; m -= a8[2 * k] * right; k = 2 * k + right;
  right = m > v[2 * k]; m -= v[2 * k] * right; k = 2 * k + right;
  *mass = m;
  return k;
}

// Slots at shares of the sum of the filled slots, and their leaves.
void find(const double *leaf, double *nodes, int64_t size, int64_t filled, const double *share, int64_t n,
          int64_t *slots, double *leaves) {
  Level levels[16];
  int top = 0;
  for (levels[0] = first_level(nodes, size); levels[top].count > 1; top++) levels[top + 1] = next_level(levels[top]);
  double total = query(leaf, 0, nodes, 0, size, filled);
  for (int64_t i = 0; i < n; i += SIDE) {
    int m = n - i < SIDE ? (int)(n - i) : SIDE;
    int64_t k[SIDE];
    double v[SIDE];
    for (int j = 0; j < m; j++) { k[j] = 0; v[j] = share[i + j] * total; }
    for (int l = top - 1; l >= -1; l--) {
      const double *below = l < 0 ? leaf : levels[l].sum;
      int64_t count = l < 0 ? size : levels[l].count;
      for (int j = 0; j < m; j++) {
        k[j] *= WIDE;
        // Rounding can carry the last bit of mass past the last slot.
        if (k[j] >= count) continue;
        k[j] += child_at(below + k[j], v + j);
        if (l < 0 || k[j] >= count) continue;
        const double *next = (l ? levels[l - 1].sum : leaf) + k[j] * WIDE;
        __builtin_prefetch(next);
        __builtin_prefetch(next + 8);
      }
    }
    for (int j = 0; j < m; j++) {
      slots[i + j] = k[j] < filled ? k[j] : filled - 1;
      leaves[i + j] = leaf[slots[i + j]];
    }
  }
}

// Rows.

typedef struct {
  char *stored;
  char *rows;
  int64_t bytes;   // Of one row.
  int64_t number;  // 4 or 8: single or double precision, which must be finite; else 0.
} Column;

// How often this thread waited for a page of a file.
int64_t waits(void) {
  struct rusage usage;
  return getrusage(RUSAGE_THREAD, &usage) ? 0 : usage.ru_majflt;
}

// Have the system read the pages of rows all at once, where each would be waited for when it is touched.
void ask(const Column *columns, int64_t count, const int64_t *slots, int64_t n, int64_t end) {
  uintptr_t page = sysconf(_SC_PAGESIZE);
  if (outside(slots, n, end)) return;
  for (int64_t c = 0; c < count; c++)
    for (int64_t i = 0; columns[c].bytes && i < n; i++) {
      uintptr_t row = (uintptr_t)(columns[c].stored + slots[i] * columns[c].bytes), first = row / page * page;
      madvise((void *)first, row + columns[c].bytes - first, MADV_WILLNEED);
    }
}

// Copy rows of slots. Returns 1, and does nothing, if a slot is not below `end`.
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

// Returns 1 if a number of new rows is not finite that must be.
int64_t not_finite(const Column *columns, int64_t count, int64_t n) {
  for (int64_t k = 0; k < count; k++) {
    const Column *c = columns + k;
    // A sum of products with zero is zero only if all numbers are finite.
    int64_t numbers = c->number ? n * c->bytes / c->number : 0;
    double sum = 0.0;
    if (c->number == 4) for (int64_t i = 0; i < numbers; i++) sum += 0.0 * ((const float *)c->rows)[i];
    if (c->number == 8) for (int64_t i = 0; i < numbers; i++) sum += 0.0 * ((const double *)c->rows)[i];
    if (sum != 0.0) return 1;
  }
  return 0;
}

// Write rows in slots. Returns 1, and writes nothing, if a slot is not below `end`.
int64_t scatter(const Column *columns, int64_t count, const int64_t *slots, int64_t n, int64_t end) {
  if (outside(slots, n, end)) return 1;
  for (int64_t c = 0; c < count; c++) {
    int64_t b = columns[c].bytes;
    for (int64_t i = 0; b && i < n; i++) memcpy(columns[c].stored + slots[i] * b, columns[c].rows + i * b, b);
  }
  return 0;
}

// A table of numbers: rows of `width` numbers, and in a batch its columns one after the other.

// Copy whole rows, with new numbers in their first columns. Returns 1 if a slot is not below `end`, was written
// since, as its last column shows, or has a number that is negative or not finite in the columns to be checked.
int64_t join(const double *table, int64_t width, const int64_t *slots, int64_t n, int64_t end,
             const double *written, const float *const *numbers, int64_t count, int64_t checked, double *batch) {
  if (outside(slots, n, end)) return 1;
  for (int64_t i = 0; i < n; i++) {
    const double *row = table + slots[i] * width;
    __builtin_prefetch(table + slots[i + AHEAD < n ? i + AHEAD : i] * width, 1);
    if (written && row[width - 1] != written[i]) return 1;
    for (int64_t k = count; k < width; k++) batch[k * n + i] = row[k];
  }
  int64_t wrong = 0;
  for (int64_t k = 0; k < count; k++)
    for (int64_t i = 0; i < n; i++) batch[k * n + i] = (double)numbers[k][i];
  for (int64_t j = 0; j < checked * n; j++) wrong |= !(batch[j] >= 0.0 && batch[j] < INFINITY);
  return wrong;
}

// Write the first columns of a batch; the last one of all becomes a time that rises from `time` on, unless this
// is negative. Returns 1, and writes nothing, if a slot is not below `end`.
int64_t give(double *table, int64_t width, int64_t count, const int64_t *slots, int64_t n, int64_t end,
             const double *batch, int64_t time) {
  if (outside(slots, n, end)) return 1;
  for (int64_t i = 0; i < n; i++) {
    double *row = table + slots[i] * width;
    for (int64_t k = 0; k < count; k++) row[k] = batch[k * n + i];
    if (time >= 0) row[width - 1] = (double)(time + i);
  }
  return 0;
}

typedef struct {
  const void *numbers;
  int64_t bytes;      // Of a number: 4 or 8, single or double precision.
  int64_t column;     // Where it is put.
  int64_t is_signed;  // If it may be negative.
} Source;

// Rows of new transitions: some columns have numbers of theirs, the last but one is zero, all else is NaN.
// Returns 1 if one of the numbers is not finite, or negative.
int64_t describe(const Source *sources, int64_t count, int64_t width, int64_t n, double *batch) {
  for (int64_t j = 0; j < width * n; j++) batch[j] = NAN;
  for (int64_t i = 0; i < n; i++) batch[(width - 2) * n + i] = 0.0;
  for (const Source *s = sources; s < sources + count; s++)
    for (int64_t i = 0; i < n; i++) {
      double v = s->bytes == 4 ? ((const float *)s->numbers)[i] : ((const double *)s->numbers)[i];
      if (!(fabs(v) < INFINITY && (s->is_signed || v >= 0.0))) return 1;
      batch[s->column * n + i] = v;
    }
  return 0;
}

// Add one to a column for each slot, duplicates included.
void tally(double *table, int64_t width, int64_t column, const int64_t *slots, int64_t n) {
  for (int64_t i = 0; i < n; i++) {
    __builtin_prefetch(table + slots[i + AHEAD < n ? i + AHEAD : i] * width, 1);
    table[slots[i] * width + column] += 1.0;
  }
}
