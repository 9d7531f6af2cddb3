within Drives;
package Setups "Experiment models, one FMU each"
end Setups;
