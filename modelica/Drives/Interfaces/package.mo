within Drives;
package Interfaces "Flanges, signal connectors and partial models"
end Interfaces;
