/* A robot held against a tube around a linear model's simulation: C99, no allocation, no libraries
 * but libm. The table comes from `nlsid export DIR --c table.c`; the numbers are those of the node
 * funnel_monitor. Left out: CUSUM, forecasts, and the commands' range in training.
 *
 *     static nlsid_monitor monitor;
 *     nlsid_start(&monitor, &nlsid_table);
 *     nlsid_reading now = nlsid_update(&monitor, t, y, u);   one call a sample, in order
 */
#ifndef NLSID_MONITOR_H
#define NLSID_MONITOR_H

#define NLSID_MOST_ORDER 32 /* lags of the model */
#define NLSID_MOST_TUBES 4

#ifdef __cplusplus
extern "C" {
#endif

typedef enum { NLSID_UNKNOWN, NLSID_INSIDE, NLSID_ASSUMPTION_VIOLATED, NLSID_OUTSIDE } nlsid_status;

typedef struct {
  double rho, R, up, level, peak, width;
  long samples;    /* how many the proof covers; 0: for ever */
  const double *L; /* of `order` numbers, as all below but `b`, which has one more */
} nlsid_tube;

typedef struct {
  int order, tubes;
  double period, c, D;
  const double *a, *b, *B, *f, *hidden;
  const nlsid_tube *tube;
} nlsid_design;

extern const nlsid_design nlsid_table;

/* margin: 1 on the model's simulation, 0 on the tube's boundary; NaN if unknown. assumption: the
 * part of what is assumed that is used, 1 is all of it. nominal: what the model simulates. */
typedef struct {
  nlsid_status status;
  double margin, assumption, nominal;
} nlsid_reading;

typedef struct {
  const nlsid_design *design;
  double due, last, pace; /* of the stamps, in s; pace: in periods */
  int collected;          /* samples of the start */
  long k;                 /* samples since it */
  double y[NLSID_MOST_ORDER], u[NLSID_MOST_ORDER];
  double x[NLSID_MOST_TUBES + 1][NLSID_MOST_ORDER]; /* each observer's, then the simulation's */
  double spent[NLSID_MOST_TUBES], largest[NLSID_MOST_ORDER];
} nlsid_monitor;

/* A new run. */
void nlsid_start(nlsid_monitor *monitor, const nlsid_design *design);

/* The reading of the sample stamped t (s), measured y and commanded u, in the model's units. A
 * sample that was not measured has y = NaN; without u, or after one that never came, a new run
 * starts by itself, and its first `order` readings are unknown. */
nlsid_reading nlsid_update(nlsid_monitor *monitor, double t, double y, double u);

#ifdef __cplusplus
}
#endif
#endif
