/* Holds a recording against the tube of table.c, without ROS: reads lines `t,y,u` (s, and the model's
 * units) after an optional heading, writes a line for each. Its exit status is 1 if a sample is not
 * inside; else 2 if a line could not be read, or no sample was judged.
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
  int bad = 0, judged = 0, unread = 0, lines = 0;
  nlsid_start(&monitor, &nlsid_table);
  while (fgets(line, sizeof line, stdin)) {
    if (sscanf(line, "%lf,%lf,%lf", &t, &y, &u) != 3) {
      if (lines++ > 0) unread++; /* the first line may be a heading */
      continue;
    }
    lines++;
    const nlsid_reading now = nlsid_update(&monitor, t, y, u);
    printf("%.6f %s %.17g\n", t, words[now.status], now.margin);
    bad |= now.status > NLSID_INSIDE;
    judged |= now.status >= NLSID_INSIDE;
  }
  if (unread > 0) fprintf(stderr, "lines that are no t,y,u: %d\n", unread);
  return bad ? 1 : unread > 0 || !judged ? 2 : 0;
}
