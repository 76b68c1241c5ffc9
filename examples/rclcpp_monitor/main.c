/* Holds a recording against the tube of table.c, without ROS: reads lines `t,y,u` (s, and the model's
 * units), writes a line for each. Its exit status is 1 if a sample is not inside.
 *
 *     nlsid export DIR --c table.c
 *     gcc -std=c99 -O2 -ffp-contract=off -o monitor main.c nlsid_monitor.c table.c -lm
 *     ./monitor < recording.csv
 */
#include <stdio.h>

#include "nlsid_monitor.h"

int main(void) {
  static const char *const words[] = {"unknown", "inside", "assumption violated", "outside"};
  static nlsid_monitor monitor; /* all that it needs; nothing is allocated */
  char line[256];
  double t, y, u;
  int bad = 0;
  nlsid_start(&monitor, &nlsid_table);
  while (fgets(line, sizeof line, stdin)) {
    if (sscanf(line, "%lf,%lf,%lf", &t, &y, &u) != 3) continue; /* the heading */
    const nlsid_reading now = nlsid_update(&monitor, t, y, u);
    printf("%.6f %s %.17g\n", t, words[now.status], now.margin);
    bad |= now.status > NLSID_INSIDE;
  }
  return bad;
}
