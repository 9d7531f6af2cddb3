# A double pendulum. Included by the Makefile at the top.
DOUBLE_PENDULUM ?= ../shared/data/double_pendulum

# Averaged to 100 Hz; the noise of an angle is one count of its encoder, uniformly distributed.
campaigns/double_pendulum/measurements.h5: | $(READY)
	$(BIN)/fmuid import $(DOUBLE_PENDULUM)/sys_id_*.csv --setup double_pendulum --out $@ --resample 100 --method mean \
	  -i tau_meas1 -i tau_meas2 --unit tau_meas1=N.m --unit tau_meas2=N.m --signal tau_meas1 --signal tau_meas2 \
	  --signal pos_meas1 --signal pos_meas2 --unit pos_meas1=rad --unit pos_meas2=rad \
	  --sigma pos_meas1=1.1e-4 --sigma pos_meas2=1.1e-4 --title "Double pendulum, design C.1"

# Then compare the published parameters with those found, and the predictions of both for the validation runs.
identify-double-pendulum: campaigns/double_pendulum/measurements.h5
	$(BIN)/fmuid identify campaigns/double_pendulum --out runs/double_pendulum
	$(BIN)/python -m benchmarks.beside_published runs/double_pendulum authors

diagnose-double-pendulum: identify-double-pendulum
	$(BIN)/fmuid diagnose runs/double_pendulum --out runs/double_pendulum-diagnosis
