within Pendulum;
package Components "Motor, gear, encoder, controller and arm"
end Components;
