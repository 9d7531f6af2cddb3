# Two boards with heaters. Included by the Makefile at the top.
TCLAB ?= ../TCLab

# Three versions of one file, each the log of another test; the first samples determine where a run begins, in K.
campaigns/temperature_lab/measurements.h5: | $(READY)
	@mkdir -p build/temperature_lab
	for run in half:196c74e full:f3d31ff later:f9a9d4b; do \
	  git -C $(TCLAB) show $${run#*:}:notebooks/step_test_data.csv > build/temperature_lab/$${run%:*}.csv || exit 1; done
	$(BIN)/fmuid import build/temperature_lab/*.csv --setup board --out $@ --quiet \
	  -i Q1 --unit Q1=% --unit T1=degC --unit T2=degC --sigma T1=0.15 --sigma T2=0.15 \
	  --machine half:first --machine full:second --machine later:second --setting half:heater.P_max=4.2 \
	  --setting half:T1_start=295.66 --setting half:T2_start=294.37 --setting half:T_room=294.37 \
	  --setting full:T1_start=294.69 --setting full:T2_start=295.66 --setting full:T_room=294.69 \
	  --setting later:T1_start=296.63 --setting later:T2_start=297.92 --setting later:T_room=296.63

identify-temperature-lab: campaigns/temperature_lab/measurements.h5
	$(BIN)/fmuid identify campaigns/temperature_lab --out runs/temperature_lab
