/* See nlsid_monitor.h. Compile with -ffp-contract=off: the proof's rounding is of single steps. */
#include "nlsid_monitor.h"

#include <math.h>

/* As in nlsid_core.running.tubes, grid and funnels.factor, where each has its reason. */
#define TOLERANCE 0.25
#define FOLLOW 0.1
#define PACE 0.01
#define OTHER_PACE 0.01
#define MOST_ROUNDING 1e-3
#define UNIT 0x1p-53
#define STEPS 16.0

static nlsid_reading unknown(void) {
  return (nlsid_reading){NLSID_UNKNOWN, NAN, NAN, NAN};
}

static void begin(nlsid_monitor *m) {
  m->collected = 0;
  m->k = 0;
  for (int j = 0; j < m->design->tubes; j++) m->spent[j] = 0.0;
  for (int i = 0; i < m->design->order; i++) m->largest[i] = 0.0;
}

void nlsid_start(nlsid_monitor *m, const nlsid_design *design) {
  m->design = design;
  m->due = m->last = NAN;
  m->pace = 0.0;
  begin(m);
}

/* Whether the sample stamped t is one; a new run starts where some before it did not come. */
static int take(nlsid_monitor *m, double t) {
  const double period = m->design->period;
  if (!isfinite(t)) return 0;
  if (isnan(m->due)) m->due = t;
  const double late = (t - m->due) / period, lost = rint(late);
  if (!isfinite(late) || lost < 0.0) return 0;
  if (m->last < t) {
    const double since = (t - m->last) / period, whole = rint(since);
    m->pace += PACE * (since - (whole > 1.0 ? whole : 1.0) - m->pace);
  }
  m->last = t;
  if (fabs(late - lost) > TOLERANCE) {
    m->due = t + period;
    begin(m);
    return 0;
  }
  m->due += (lost + 1.0) * period + FOLLOW * (late - lost) * period;
  if (fabs(m->pace) > OTHER_PACE) {
    begin(m);
    return 0;
  }
  if (lost > 0.0) begin(m);
  return 1;
}

/* The state that the first samples determine, in every observer and in the simulation. */
static void collect(nlsid_monitor *m, double y, double u) {
  const nlsid_design *d = m->design;
  const int n = d->order;
  m->y[m->collected] = y;
  m->u[m->collected] = u;
  if (++m->collected < n) return;
  for (int i = 0; i < n; i++) {
    double by_y = 0.0, by_u = 0.0;
    for (int k = 0; i + k < n; k++) {
      by_y += d->a[i + k] * m->y[n - 1 - k];
      by_u += d->b[i + 1 + k] * m->u[n - 1 - k];
    }
    for (int j = 0; j <= d->tubes; j++) m->x[j][i] = by_y + by_u;
  }
}

/* x+ = A x + B u + f, of all; A's first column is a, and the rest of it shifts. */
static void advance(nlsid_monitor *m, double u) {
  const nlsid_design *d = m->design;
  for (int j = 0; j <= d->tubes; j++) {
    const double first = m->x[j][0];
    for (int i = 0; i < d->order; i++) {
      const double shifted = i + 1 < d->order ? m->x[j][i + 1] : 0.0;
      m->x[j][i] = (d->a[i] * first + shifted) + (d->B[i] * u + d->f[i]);
    }
  }
  m->k++;
}

/* What rounding can hide of the output's distance from the simulation's, `nominal`. */
static double hides(nlsid_monitor *m, double nominal) {
  const nlsid_design *d = m->design;
  const double *x = m->x[d->tubes];
  int grows = 0;
  double hidden = 0.0;
  for (int i = 0; i < d->order; i++) grows |= fabs(x[i]) > m->largest[i];
  for (int i = 0; i < d->order; i++) {
    const double most = 1.1 * fabs(x[i]);
    if (grows && most > m->largest[i]) m->largest[i] = most;
    hidden += d->hidden[i] * m->largest[i];
  }
  return hidden + STEPS * UNIT * fabs(nominal);
}

static nlsid_reading judge(nlsid_monitor *m, double y, double u) {
  const nlsid_design *d = m->design;
  const double direct = d->D * u + d->c, nominal = m->x[d->tubes][0] + direct;
  const double deviation = y - nominal, hidden = hides(m, nominal);
  double e[NLSID_MOST_TUBES], size = 0.0, narrowest = INFINITY, used = -INFINITY;
  int finite = isfinite(nominal), lasts = 0;
  for (int j = 0; j < d->tubes; j++) {
    const nlsid_tube *tube = &d->tube[j];
    e[j] = y - (m->x[j][0] + direct);
    m->spent[j] = tube->rho * m->spent[j] + tube->up * ((tube->R * e[j]) * e[j]);
    finite = finite && isfinite(m->spent[j]);
    narrowest = fmin(narrowest, tube->width);
    if (tube->samples && m->k >= tube->samples) continue;
    const double part = e[j] / tube->peak;
    lasts = 1;
    size = fmax(size, (fabs(deviation) + hidden) / tube->width);
    used = fmax(used, fmax(m->spent[j] / tube->level, part * part));
  }
  advance(m, u);
  for (int j = 0; j < d->tubes; j++)
    for (int i = 0; i < d->order; i++) m->x[j][i] += d->tube[j].L[i] * e[j];
  for (int j = 0; j <= d->tubes; j++)
    for (int i = 0; i < d->order; i++) finite = finite && isfinite(m->x[j][i]);
  if (!finite) {
    begin(m);
    if (!isfinite(nominal) || !((fabs(deviation) + hidden) / narrowest > 1.0)) return unknown();
    return (nlsid_reading){NLSID_OUTSIDE, -INFINITY, INFINITY, NAN};
  }
  if (!lasts || !(hidden / narrowest <= MOST_ROUNDING)) return unknown();
  nlsid_status status = used <= 1.0 ? NLSID_INSIDE : NLSID_ASSUMPTION_VIOLATED;
  if (!(size <= 1.0)) status = NLSID_OUTSIDE;
  return (nlsid_reading){status, 1.0 - size, used, nominal};
}

nlsid_reading nlsid_update(nlsid_monitor *m, double t, double y, double u) {
  if (!take(m, t)) return unknown();
  const int runs = m->collected >= m->design->order;
  if (!isfinite(u) || (!isfinite(y) && !runs)) {
    begin(m);
    return unknown();
  }
  if (!isfinite(y)) {
    advance(m, u);
    for (int j = 0; j < m->design->tubes; j++) m->spent[j] *= m->design->tube[j].rho;
    return unknown();
  }
  if (runs) return judge(m, y, u);
  collect(m, y, u);
  return unknown();
}
