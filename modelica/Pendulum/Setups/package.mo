within Pendulum;
package Setups "What is exported as FMUs"
end Setups;
