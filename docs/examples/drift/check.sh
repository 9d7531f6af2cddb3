#!/bin/sh
# Fails when MyDrive.fmu no longer does what its references say; drift/report.md then says where.
set -e
cd "$(dirname "$0")"
fmuid build MyDrive.mo MyDrive --out .
fmuid compare MyDrive.fmu references --funnel 0.01 --funnel-time 0.002 --out drift
