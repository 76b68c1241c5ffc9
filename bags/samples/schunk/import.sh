#!/bin/sh
# Makes the bags beside this file: import.sh FOLDER, where FOLDER holds Robot/measurement_1, ...
set -eu
here=$(dirname "$0")
table=$(mktemp)
minute=0
for trial in 1 20 40 60 80 100; do
  set --  "$1"
  for joint in 1 2 3 4 5 6; do
    set -- "$@" \
      --signal "/joint_states:position[name=joint_$joint]=position_$joint" \
      --signal "/joint_states:velocity[name=joint_$joint]=velocity_$joint" \
      --signal "/joint_states:effort[name=joint_$joint]=effort_$joint"
  done
  folder=$1/Robot/measurement_$trial
  data=$1
  shift
  {
    for column in effort position velocity; do
      for joint in 1 2 3 4 5 6; do
        printf '%s_%s,' $column $joint
      done
    done | sed 's/,$//'
    echo
    paste -d, "$folder/input.csv" "$folder/trajectory.csv" | head -n "$(wc -l < "$folder/input.csv")"
  } > "$table"
  nlsid bag import "$table" "$@" \
    --out "$here/$(printf 'trial_%03d' "$trial")" \
    --type /joint_states=sensor_msgs/msg/JointState --period 0.004 \
    --start $((1514764800 + 60 * minute)) \
    --custom "source=S. Liu and M. Althoff, Reachset conformance of forward dynamic models for the formal analysis of robots, IROS 2018; measured from a Schunk 6-DoF arm" \
    --custom "source_trial=measurement_$trial" --custom licence=CC0-1.0
  set -- "$data"
  minute=$((minute + 1))
done
rm "$table"
